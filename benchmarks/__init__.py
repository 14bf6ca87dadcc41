"""Benchmarks: timings as ratios within one run, accuracy, and comparisons."""

import os

# One thread per process, as in the daemon, so that a time is one of work. The libraries read this when they are loaded.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"
