"""Read-only drivers that turn what a machine sends into samples, and the simulated plant.

This package never imports ``otolith``; the daemon imports it. Here is what keeps packages out of memory that a
library would import wherever they are installed.
"""

import importlib.abc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def import_refused(name: str) -> Iterator[None]:
    """Let each import of ``name`` fail meanwhile, as if it were not installed. One that is imported already stays.

    None in ``sys.modules`` does not do: Cython takes it for the module.
    """
    finder = _Refusal(name)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _Refusal(importlib.abc.MetaPathFinder):
    def __init__(self, name: str) -> None:
        self._name = name

    def find_spec(self, name: str, *_: object) -> None:
        if name == self._name:
            raise ModuleNotFoundError(f"import of {name} is refused", name=name)


def keep_pandas_out() -> None:
    """Let pyarrow decide that there is no pandas, which takes 34 MB. It decides once, at its first conversion."""
    import pyarrow as pa  # noqa: PLC0415 - the CAN driver uses this module, and needs no pyarrow

    with import_refused("pandas"):
        pa.array([0]).to_numpy()
