"""Otolith compared with other estimators, on the same windows in the same run: ``python -m benchmarks.estimators``."""

import os

# One thread for all methods, so that a ratio of times is one of work. The libraries read this when they are loaded.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"
