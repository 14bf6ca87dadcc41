"""The cache of compiled kernels: shared, private, bounded, and never stale."""

import dataclasses
import errno
import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from otolith import kernel_cache
from otolith.machine import find_twin
from otolith.twin.kernel import identity_of
from otolith_drivers.errors import ServiceError
from tests.waiting import PATIENCE

PROGRAM = """
import sys, time
import numpy as np
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of
twin = find_twin("dc_motor")
drive = Excitation.uniform(np.zeros((10, 2)), 0.01)
print(kernel_of(twin).simulate(np.array([[p.nominal for p in twin.parameters]]), np.zeros((1, 2)), drive).sum())
print("sympy" in sys.modules)
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "otolith" / "kernels"


def start() -> "subprocess.Popen[str]":
    return subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True)


@pytest.mark.full
def test_two_processes_compile_a_kernel_once(cache: Path) -> None:
    together = [start(), start()]
    outputs = [process.communicate(timeout=5 * PATIENCE)[0] for process in together]
    assert [output.splitlines()[0] for output in outputs] == ["0.0", "0.0"]
    compiled = list(cache.glob("*/__pycache__/*.nbc"))
    assert len(compiled) == 1
    before = compiled[0].stat().st_mtime_ns
    third = start().communicate(timeout=5 * PATIENCE)[0].splitlines()
    assert third == ["0.0", "False"]  # a cached kernel needs no SymPy
    assert compiled[0].stat().st_mtime_ns == before


@pytest.mark.full
@pytest.mark.parametrize(
    "cuts",
    [
        (("nbi", 0.5), ("nbc", 0.5)),
        (("nbi", 0.0), ("nbc", 0.0), ("nbc", 0.9)),
    ],
)
def test_truncated_cache_file_is_compiled_again(cache: Path, cuts: tuple[tuple[str, float], ...]) -> None:
    start().communicate(timeout=5 * PATIENCE)
    for ending, keep in cuts:
        (half,) = cache.glob(f"*/__pycache__/*.{ending}")
        content = half.read_bytes()
        half.write_bytes(content[: int(keep * len(content))])
        assert start().communicate(timeout=5 * PATIENCE)[0].splitlines()[0] == "0.0", (ending, keep)
        assert half.stat().st_size == pytest.approx(len(content), rel=0.01), (ending, keep)


def test_cache_folder_is_private(cache: Path) -> None:
    kernel_cache.load("private", lambda: "")
    assert cache.stat().st_mode & 0o077 == 0
    cache.chmod(0o777)
    with pytest.raises(ServiceError, match="writable by no other"):
        kernel_cache.load("other", lambda: "")


def test_a_module_gets_its_name_when_it_is_on_the_disk(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        for _ in range(3):
            with pytest.raises(OSError, match="No space left"):
                kernel_cache.load("durable", lambda: "number = 1")
    (left,) = [path for path in cache.glob("*/*") if path.is_file()]
    assert left.suffix == ".new"
    assert kernel_cache.load("durable", lambda: "number = 2").number == 2
    assert not left.exists()


def test_library_version_changes_the_kernel(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def make() -> str:
        made.append("")
        return f"number = {len(made)}"

    assert kernel_cache.load("versions", make).number == 1
    assert kernel_cache.load("versions", make).number == 1
    monkeypatch.setattr(kernel_cache, "version", lambda name: f"{name} of tomorrow")
    assert kernel_cache.load("versions", make).number == 2
    assert cache.is_dir()


def test_identity_depends_on_equations_only() -> None:
    twin = find_twin("dc_motor")
    assert identity_of(dataclasses.replace(twin, title="another")) == identity_of(twin)
    stiffer = dataclasses.replace(twin, equations=((twin.equations[0][0], "V_a/L_a"), twin.equations[1]))
    assert identity_of(stiffer) != identity_of(twin)


def test_old_kernels_are_removed(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "MAX_BYTES", 35_000)
    for index in range(6):
        kernel_cache.load(f"number {index}", lambda: "#" * 10_000)
        time.sleep(0.01)  # so that their times differ
    assert len([path for path in cache.iterdir() if path.is_dir()]) == 3


RELEASED = """
import ctypes, re, sys
from pathlib import Path
from numba import njit
from otolith import kernel_cache

def resident_kb():
    text = Path("/proc/self/smaps").read_text(encoding="utf-8")
    kilobytes = re.findall(r" r-xp .*libllvmlite\\.so\\n(?:.+kB\\n)*?Rss: +(\\d+) kB", text)
    return sum(map(int, kilobytes))

class OtherLibrary:  # as musl: without malloc_trim
    madvise = ctypes.CDLL(None).madvise

if sys.argv[1] == "other":
    ctypes.CDLL = lambda name: OtherLibrary

add = njit(lambda a, b: a + b)
assert add(1, 2) == 3
before = resident_kb()
kernel_cache.release_compiler()
print(before, resident_kb())
assert add(1.5, 2.0) == 3.5  # compiled again, for other types
"""


@pytest.mark.parametrize("library", ["glibc", "other"])
def test_the_compiler_returns_its_memory_and_goes_on_compiling(library: str) -> None:
    done = subprocess.run([sys.executable, "-c", RELEASED, library], capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert before > 10_000  # kB
    assert after < 0.1 * before


def test_a_kernel_that_another_process_has_locked_is_not_removed(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel_cache.load("old", lambda: "#" * 10_000)
    (old,) = cache.glob("*.lock")
    monkeypatch.setattr(kernel_cache, "MAX_BYTES", 5_000)
    with kernel_cache._locked(old):
        kernel_cache.load("new", lambda: "#" * 10_000)
        assert old.exists()
        assert old.with_suffix("").is_dir()
    kernel_cache.load("newer", lambda: "#" * 10_000)
    assert not old.exists()
    assert not old.with_suffix("").exists()


def test_a_lock_is_held_by_one_although_its_file_is_removed(tmp_path: Path) -> None:
    lock, inside, most = tmp_path / "lock", list[int](), list[int]()

    def take(number: int) -> None:
        for _ in range(20):
            with kernel_cache._locked(lock):
                inside.append(number)
                most.append(len(inside))
                time.sleep(0.001)
                inside.remove(number)
                lock.unlink()

    threads = [threading.Thread(target=take, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert len(most) == 80
    assert max(most) == 1


def test_an_error_while_a_lock_is_held_is_not_taken_for_a_removed_lock(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="kernel"), kernel_cache._locked(tmp_path / "lock"):
        raise FileNotFoundError("kernel")


@pytest.mark.parametrize("disk", ["read-only", "full"])
def test_a_cache_that_cannot_be_written_is_read(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, disk: str
) -> None:
    """The answers of the operating system are replaced: a disk that is read-only does not stop root."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    first = kernel_cache.load(f"kept {disk}", lambda: "number = 1")
    (source,) = cache.glob("*/*.py")
    monkeypatch.delitem(sys.modules, first.__name__)
    before = sorted(cache.rglob("*"))
    if disk == "full":
        usage = shutil.disk_usage(tmp_path)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1 << 20))
    else:
        access = os.access
        monkeypatch.setattr(
            os, "access", lambda path, mode: not Path(path).is_relative_to(cache) and access(path, mode)
        )
    again = kernel_cache.load(f"kept {disk}", lambda: "number = 2")
    other = kernel_cache.load(f"made {disk}", lambda: "number = 3")
    assert (again.number, other.number) == (1, 3)
    (copy,) = (tmp_path / "run" / "kernels").glob(f"{source.parent.name}/*.py")
    assert copy.stat().st_mtime_ns == source.stat().st_mtime_ns
    assert sorted(cache.rglob("*")) == before
    assert caplog.text.count("kernels are kept in") == 1
    cache.chmod(0o777)
    with pytest.raises(ServiceError, match="writable by no other"):
        kernel_cache.load(f"untrusted {disk}", lambda: "number = 4")
