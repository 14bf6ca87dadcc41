"""Tests of both packages. Imported before anything that loads NumPy."""

import os

# As in the daemon: the matrices are small, and on a busy computer threads of the linear algebra wait for each other.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
