"""How often the search finds components that are there, and what PySINDy finds: ``python -m benchmarks.discovery``."""

import os

# One thread for everybody: two processes share two cores. The libraries read this when they are loaded.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"
