"""The comparison with other estimators with a small budget; ``python -m benchmarks.estimators`` has the full one."""

import sys

from benchmarks.estimators.__main__ import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or ["--windows", "40", "--slow", "3"]))
