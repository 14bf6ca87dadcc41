"""What the reports state after a change of a simulated machine: ``python -m benchmarks.changes``."""

import os

# One thread per process: two processes share two cores. The libraries read this when they are loaded.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"
