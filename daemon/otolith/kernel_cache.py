"""Compiled kernels on disk: the one place below the heart that touches files.

What it returns depends on its arguments alone. The folder is private to its user, because what is loaded from it runs;
two processes that want the same kernel at once compile it once; what other versions made is not used and, in the end,
removed.
"""

import fcntl
import hashlib
import importlib.util
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

from otolith_drivers.errors import ServiceError
from otolith_drivers.user_dirs import cache_directory

MOST_KERNELS = 64  # folders; the oldest beyond are removed
GENERATOR = sorted((Path(__file__).parent / "twin").glob("*.py"))
LIBRARIES = ("numba", "llvmlite", "numpy", "sympy")


def load(identity: str, make_source: Callable[[], str]) -> ModuleType:
    """The module of ``make_source()``, which is only called for an ``identity`` that the cache does not have.

    Raises:
        ServiceError: the cache folder belongs to somebody else or can be written by others.
    """
    versions = " ".join(f"{name} {version(name)}" for name in LIBRARIES)
    text = f"{identity}\n{versions}\npython {sys.version}\n{_generator()}"
    key = hashlib.sha256(text.encode()).hexdigest()[:24]
    name = f"otolith_kernel_{key}"
    if name in sys.modules:
        return sys.modules[name]
    store = cache_directory("kernels")
    folder = store / key
    with _locked(store / f"{key}.lock"):
        file = folder / f"{name}.py"
        if not file.exists():
            folder.mkdir(mode=0o700, exist_ok=True)
            _write(file, make_source())
            _remove_old(store, keep=folder)
        os.utime(folder)
        return _import(name, file)


@cache
def _generator() -> str:
    """What tells one version of the generator from another: its own text, so that nobody has to remember a number."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in GENERATOR)).hexdigest()


@contextmanager
def compiling(module: ModuleType) -> Iterator[None]:
    """Held around the first call of a kernel: another process waits and then finds the result in the cache."""
    file = Path(module.__file__ or "")
    with _locked(file.parent.parent / f"{file.parent.name}.lock"):
        yield


def discard(module: ModuleType) -> None:
    """Remove what is compiled of a module: a file that a power cut left half would fail for ever."""
    shutil.rmtree(Path(module.__file__ or "").parent / "__pycache__", ignore_errors=True)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w", encoding="utf-8") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _write(file: Path, text: str) -> None:
    """All or nothing: a process that dies here leaves no half of a module."""
    handle, temporary = tempfile.mkstemp(dir=file.parent, suffix=".new")
    with os.fdopen(handle, "w", encoding="utf-8") as stream:
        stream.write(text)
    Path(temporary).replace(file)


def _import(name: str, file: Path) -> ModuleType:
    specification = importlib.util.spec_from_file_location(name, file)
    if specification is None or specification.loader is None:
        raise ServiceError(f"{file}: cannot be loaded as a module")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    specification.loader.exec_module(module)
    return module


def _remove_old(store: Path, keep: Path) -> None:
    folders = sorted((path for path in store.iterdir() if path.is_dir()), key=lambda path: path.stat().st_mtime)
    for folder in folders[:-MOST_KERNELS]:
        if folder != keep:
            shutil.rmtree(folder, ignore_errors=True)
            (store / f"{folder.name}.lock").unlink(missing_ok=True)
