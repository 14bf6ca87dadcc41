"""Compiled kernels on disk: the only place below the adaptation core that touches files.

The result of :func:`load` depends on its arguments alone. The folder must be private to the user, because the modules
in it are executed. Two processes that need the same kernel at once compile it once. Kernels of other versions of
Otolith or of its libraries are not used, and removed when the cache is full.
"""

import ctypes
import fcntl
import hashlib
import importlib.util
import logging
import mmap
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from otolith_drivers.errors import ServiceError
from otolith_drivers.user_dirs import cache_directory, spare_cache_directory

log = logging.getLogger(__name__)

MAX_BYTES = 200_000_000  # of the cache: the least recently used kernels beyond are removed
MIN_FREE_BYTES = 32 << 20  # of the disk of the cache, below which kernels are kept in another folder
GENERATOR = [*sorted((Path(__file__).parent / "twin").glob("*.py")), Path(__file__).parent / "fmu" / "calls.py"]
SOURCE = "(source of a twin)"
LIBRARIES = ("numba", "llvmlite", "numpy", "sympy")


def load(identity: str, make_source: Callable[[], str]) -> ModuleType:
    """Return the module with the source ``make_source()``, which is called only if ``identity`` is not in the cache.

    Raises:
        ServiceError: the cache folder belongs to another user or can be written by others.
    """
    versions = " ".join(f"{name} {version(name)}" for name in LIBRARIES)
    text = f"{identity}\n{versions}\npython {sys.version}\n{_generator_hash()}"
    key = hashlib.sha256(text.encode()).hexdigest()[:24]
    name = f"otolith_kernel_{key}"
    if name in sys.modules:
        return sys.modules[name]
    store, earlier = _store()
    folder = store / key
    with _locked(store / f"{key}.lock"):
        file = folder / f"{name}.py"
        if earlier is not None and not file.exists() and (earlier / key).is_dir():
            shutil.copytree(earlier / key, folder, dirs_exist_ok=True)  # with the times by which Numba knows its code
        if not file.exists():
            folder.mkdir(mode=0o700, exist_ok=True)
            _write(file, make_source())
            _report(CompileStep(SOURCE, is_end=True, compiled=True))
            _remove_old(store, keep=folder)
        os.utime(folder)
        return _import(name, file)


def _store() -> tuple[Path, Path | None]:
    """Return the folder of the kernels, and one from which they are copied: a disk that cannot be written."""
    try:
        store = cache_directory("kernels")
        if shutil.disk_usage(store).free >= MIN_FREE_BYTES:
            return store, None
        reason = f"{store}: its disk has less than {MIN_FREE_BYTES >> 20} MB free"
    except ServiceError as error:
        reason = str(error)
    store, earlier = spare_cache_directory("kernels")
    _warn(f"{reason}; until that is mended, kernels are kept in {store}")
    return store, earlier


@cache
def _warn(text: str) -> None:
    log.warning("%s", text)


@cache
def _generator_hash() -> str:
    """Return a hash of the code that generates kernels, so that no version number has to be maintained."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in GENERATOR)).hexdigest()


class CompileStep(NamedTuple):
    """The first call of a kernel in this process begins or ends."""

    kernel: str
    is_end: bool
    compiled: bool  # At the end: whether it was compiled, and not loaded

    @property
    def is_kernel(self) -> bool:
        """Whether it is a kernel, and not the source of the kernels of a twin."""
        return self.kernel != SOURCE


_observers: list[Callable[[CompileStep], None]] = []


@contextmanager
def observed(observer: Callable[[CompileStep], None]) -> Iterator[None]:
    """Call ``observer`` with each step of this process, for its progress."""
    _observers.append(observer)
    try:
        yield
    finally:
        _observers.remove(observer)


@contextmanager
def compiling(module: ModuleType, function: Any, kernel: str) -> Iterator[None]:
    """Hold the lock of a kernel during its first call: other processes wait, then load the compiled code.

    ``kernel`` names it for observers.
    """
    file = Path(module.__file__ or "")
    _report(CompileStep(kernel, is_end=False, compiled=False))
    with _locked(file.parent.parent / f"{file.parent.name}.lock"):
        yield
    _report(CompileStep(kernel, is_end=True, compiled=bool(function.stats.cache_misses)))


def _report(step: CompileStep) -> None:
    for observer in _observers:
        observer(step)


def discard(module: ModuleType) -> None:
    """Remove the compiled code of a module: code that a power cut truncated would fail at every start."""
    shutil.rmtree(Path(module.__file__ or "").parent / "__pycache__", ignore_errors=True)


@contextmanager
def _locked(path: Path, wait: int = 0) -> Iterator[None]:
    """Hold the lock of a kernel; raise BlockingIOError if another has it and ``wait`` is ``LOCK_NB``.

    Its holder may remove the file. Who waited for it takes the lock of the new one, which others use by then.
    """
    while True:
        with path.open("w", encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_EX | wait)
            if _is_in_place(path, file.fileno()):
                yield
                return


def _is_in_place(path: Path, handle: int) -> bool:
    """Return whether an open file is still the one at ``path``."""
    with suppress(FileNotFoundError):
        return os.path.samestat(path.stat(), os.fstat(handle))
    return False


def _write(file: Path, text: str) -> None:
    """Write all or nothing, also if the computer loses power: a truncated module would fail at every start."""
    temporary = file.with_suffix(".new")  # one name, as the folder is locked: failures leave no more than one file
    with temporary.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(file)


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
    size = 0
    for folder in reversed(folders):
        size += sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if size > MAX_BYTES and folder != keep:
            lock = store / f"{folder.name}.lock"
            with suppress(BlockingIOError), _locked(lock, fcntl.LOCK_NB):  # another process loads or compiles it
                shutil.rmtree(folder, ignore_errors=True)
                lock.unlink(missing_ok=True)


def release_compiler() -> None:
    """Return memory to the system that loaded kernels do not need: LLVM's own code (50 MB), and what it has freed.

    The code is only read, so that what a later compilation needs of it comes from the file again. Freed memory returns
    by ``malloc_trim`` of glibc; with another C library, such as musl, it stays with the process.
    """
    libc = ctypes.CDLL(None)
    for line in Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines():
        if " r-xp " in line and line.endswith("libllvmlite.so"):
            begin, end = (int(text, 16) for text in line.partition(" ")[0].split("-"))
            libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), mmap.MADV_DONTNEED)
    if hasattr(libc, "malloc_trim"):
        libc.malloc_trim(0)
