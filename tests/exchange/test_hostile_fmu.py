"""What an FMU does to whoever reads, unpacks or tries it: bombs, damage, forged answers, and calls after an error."""

import gc
import os
import random
import re
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from otolith.fmu import archive, calls, trial
from otolith.fmu.archive import read_archive, unpacked
from otolith.fmu.instance import FmuInstance
from otolith.fmu.reference import FmuQuantity, FmuReference
from otolith.fmu.trial import try_fmu
from otolith.machine import load_machine
from otolith_drivers.errors import ConfigurationError
from tests.exchange.foreign import DESCRIPTION, exported, plain, write_machine
from tests.messages import assert_says, raises_saying
from tests.waiting import wait_for

BOMB = 64 << 20  # bytes that a small member becomes
PACKED = {"bz2": zipfile.ZIP_BZIP2, "lzma": zipfile.ZIP_LZMA}


def reference_of(folder: Path, fmu: bytes | None = None) -> FmuReference:
    """Write a motor and its machine file into a folder; return what its twin knows of the FMU."""
    twin = load_machine(write_machine(folder, fmu or plain()), with_driver=False).twin
    assert twin.fmu is not None
    return twin.fmu


@pytest.fixture
def reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FmuReference:
    """A motor that this computer has not tried."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return reference_of(tmp_path)


def with_member(path: Path, name: str, content: bytes, packing: int, declared: int | None = None) -> Path:
    """Write an archive of one member, whose directory declares another size if one is given."""
    with zipfile.ZipFile(path, "w", packing) as opened:
        opened.writestr(name, content)
        opened.getinfo(name).file_size = len(content) if declared is None else declared
    return path


@pytest.mark.parametrize("packing", PACKED)
@pytest.mark.parametrize("name", [DESCRIPTION, "resources/table"])
def test_only_the_packing_of_the_standard_is_unpacked(name: str, packing: str, tmp_path: Path) -> None:
    path = with_member(tmp_path / "motor.fmu", name, b"\0" * BOMB, PACKED[packing], declared=100)
    tracemalloc.start()
    with raises_saying(ValueError, name, "deflate", "export it"):
        read_archive(path)
    assert tracemalloc.get_traced_memory()[1] < BOMB / 4
    tracemalloc.stop()


def test_no_more_is_unpacked_than_an_archive_declares(tmp_path: Path) -> None:
    path = with_member(tmp_path / "motor.fmu", DESCRIPTION, b"\0" * BOMB, zipfile.ZIP_DEFLATED, declared=100)
    tracemalloc.start()
    with raises_saying(ValueError, "damaged", "export it"):
        read_archive(path)
    assert tracemalloc.get_traced_memory()[1] < BOMB / 4
    tracemalloc.stop()


def stream_of(content: bytearray, name: str) -> slice:
    """Return where the packed bytes of a member are."""
    at = content.index(name.encode()) - 30
    begin = at + 30 + int.from_bytes(content[at + 26 : at + 28], "little")
    begin += int.from_bytes(content[at + 28 : at + 30], "little")
    return slice(begin, begin + 40)


def test_a_damaged_stream_is_refused_when_it_is_read(tmp_path: Path) -> None:
    path = write_machine(tmp_path, plain()).with_name("motor.fmu")
    content = bytearray(path.read_bytes())
    content[stream_of(content, DESCRIPTION)] = b"\xff" * 40
    path.write_bytes(content)
    with raises_saying(ConfigurationError, "machine.toml", "twin.fmu", "damaged", "export it"):
        load_machine(path.with_name("machine.toml"), with_driver=False)


def test_a_damaged_stream_is_refused_when_it_is_unpacked(reference: FmuReference) -> None:
    path = Path(reference.path)
    content = bytearray(path.read_bytes())
    binary = next(name for name in read_archive(path).names if name.endswith(".so"))
    content[stream_of(content, binary)] = b"\xff" * 40
    path.write_bytes(content)
    with raises_saying(ConfigurationError, "motor.fmu", "damaged", "export it"):
        unpacked(replace(reference, digest=read_archive(path).digest))
    assert not list((path.parent / "cache").rglob("*.so"))


@pytest.mark.parametrize("name", ["resources/" + "x" * 300, "resources/notes/part"])
def test_names_that_no_disk_can_have_are_those_of_the_archive(name: str, reference: FmuReference) -> None:
    path = Path(reference.path)
    with zipfile.ZipFile(path, "a") as opened:
        opened.writestr("resources/notes", b"text")
        opened.writestr(name, b"text")
    with raises_saying(ConfigurationError, "motor.fmu", "cannot be unpacked", "export it"):
        unpacked(replace(reference, digest=read_archive(path).digest))


def test_whatever_is_damaged_is_no_crash(tmp_path: Path) -> None:
    """Bytes of the headers and of the directory, where sizes and places are."""
    own, path, draw = plain(), tmp_path / "motor.fmu", random.Random(5)  # noqa: S311 - no secret
    directory = own.rindex(b"PK\x05\x06")
    for _ in range(150):
        content = bytearray(own)
        for _ in range(draw.randint(1, 6)):
            content[draw.choice([draw.randrange(len(own)), draw.randrange(directory - 800, len(own))])] = draw.choice(
                [0, 1, 12, 14, 127, 128, 255, draw.randrange(256)]
            )
        path.write_bytes(content)
        try:
            read_archive(path)
        except ValueError as error:
            assert str(error)  # noqa: PT017 - both may happen


def test_a_place_beyond_all_numbers_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "motor.fmu"
    with zipfile.ZipFile(path, "w") as opened:
        opened.writestr(DESCRIPTION, b"text")
        opened.getinfo(DESCRIPTION).header_offset = (1 << 63) + 5
    with raises_saying(ValueError, "damaged", "export it"):
        read_archive(path)


# What the process that tries an FMU writes and does, and what the error must say.
GOOD = '{"seconds": 0.001, "integrals": []}'
PRELUDE = "import os, sys, time\nsys.stdin.buffer.read()\n"
ANSWERS: dict[str, tuple[str, tuple[str, ...]]] = {
    "a number": ("print('5')", ("no result", "mended")),
    "an empty object": ("print('{}')", ("no result", "mended")),
    "a list": ("print('[]')", ("no result", "mended")),
    "deep": ("print('[' * 30000)", ("no result", "mended")),
    "no time": ("""print('{"seconds": NaN, "integrals": []}')""", ("no result",)),
    "a text as time": ("""print('{"seconds": "1", "integrals": []}')""", ("no result",)),
    "a number as integrals": ("""print('{"seconds": 1.0, "integrals": 4}')""", ("no result",)),
    "no such state": ("""print('{"seconds": 1.0, "integrals": [[0, 99]]}')""", ("no result",)),
    "truth as a state": ("""print('{"seconds": 1.0, "integrals": [[true, 0]]}')""", ("no result",)),
    "a fault that is no text": ("""print('{"fault": {"a": 1}}')""", ("no result",)),
    "without end": (f"""while True: os.write(1, b"{"x" * 4000}")""", ("no result", "mended")),
    "another signal": ("os.kill(os.getpid(), 40)", ("signal 40", "mended")),
    "a known signal": ("os.kill(os.getpid(), 11)", ("SIGSEGV", "mended")),
    "an exit code": ("os._exit(3)", ("exit code 3", "mended")),
    "a fault": ("""print('{"fault": "no rates"}')""", ("no rates",)),
}


@pytest.fixture
def answering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Let a program of the test stand for the process that tries an FMU."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(trial, "MODULE", "answering")

    def write(code: str) -> None:
        (tmp_path / "answering.py").write_text(PRELUDE + code, encoding="utf-8")

    return write


@pytest.mark.parametrize("case", ANSWERS)
def test_an_answer_that_is_none_is_refused(
    case: str, reference: FmuReference, answering: Callable[[str], None]
) -> None:
    code, parts = ANSWERS[case]
    answering(code)
    for _ in range(2):  # nothing of it is kept
        with pytest.raises(ConfigurationError) as caught:
            try_fmu(reference)
        assert_says(str(caught.value), "motor.fmu", *parts)
        assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("kept", ["5", "{}", "[]", '{"seconds": 1.0, "integrals": [[0, 99]]}'])
def test_a_damaged_result_in_the_cache_is_found_again(
    kept: str, reference: FmuReference, answering: Callable[[str], None], tmp_path: Path
) -> None:
    answering(f"print('{GOOD}')")
    assert try_fmu(reference).seconds == 0.001
    (file,) = (tmp_path / "cache").rglob("*.tried")
    file.write_text(kept, encoding="utf-8")
    assert try_fmu(reference).seconds == 0.001


def test_what_it_prints_as_errors_is_not_kept_in_memory(
    reference: FmuReference, answering: Callable[[str], None]
) -> None:
    answering(f"for _ in range(512): os.write(2, b'x' * {BOMB >> 9})\nprint('{GOOD}')")
    tracemalloc.start()
    assert try_fmu(reference).integrals == ()
    assert tracemalloc.get_traced_memory()[1] < BOMB / 4
    tracemalloc.stop()


CHILD = "child = os.fork()\nif not child:\n    open({mark!r}, 'w').write(str(os.getpid()))\n    time.sleep(1000)\n"
ENDS = {"hang": ("time.sleep(1000)", "did not answer"), "crash": ("os._exit(3)", "exit code 3")}


@pytest.mark.parametrize("case", ENDS)
def test_processes_that_it_started_end_with_it(
    case: str,
    reference: FmuReference,
    answering: Callable[[str], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mark = tmp_path / "grandchild"
    then, part = ENDS[case]
    answering(CHILD.format(mark=str(mark)) + f"while not os.path.exists({str(mark)!r}): time.sleep(0.01)\n{then}")
    if case == "hang":
        monkeypatch.setattr(trial, "TIMEOUT", 4.0)
    with raises_saying(ConfigurationError, "motor.fmu", part):
        try_fmu(reference)
    if mark.exists():  # a busy computer may have ended it before
        wait_for(lambda: not is_running(int(mark.read_text(encoding="ascii") or 0)))


def is_running(process: int) -> bool:
    """Whether a process exists that has not ended."""
    try:
        return re.search(r"\) [^ZX]", Path(f"/proc/{process}/stat").read_text(encoding="utf-8")) is not None
    except OSError:
        return False


def _unusable(cache: Path) -> None:
    cache.write_text("a file", encoding="utf-8")


def _open_for_all(cache: Path) -> None:
    folder = cache / "otolith" / "fmus"
    folder.mkdir(parents=True)
    folder.chmod(0o777)


@pytest.mark.parametrize("make", [_unusable, _open_for_all])
def test_a_cache_that_cannot_be_used_is_named(
    make: Callable[[Path], None], reference: FmuReference, answering: Callable[[str], None], tmp_path: Path
) -> None:
    answering(f"print('{GOOD}')")
    make(tmp_path / "cache")
    with raises_saying(ConfigurationError, "motor.fmu", str(tmp_path / "cache")):
        try_fmu(reference)
    with raises_saying(ConfigurationError, "motor.fmu", str(tmp_path / "cache")):
        unpacked(reference)


def test_a_full_disk_is_named(
    reference: FmuReference, answering: Callable[[str], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(f"print('{GOOD}')")

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(Path, "write_bytes", full)
    monkeypatch.setattr("tempfile.mkdtemp", full)
    for use in (try_fmu, unpacked):
        with raises_saying(ConfigurationError, "motor.fmu", "No space left", str(tmp_path / "cache"), "room"):
            use(reference)


# Directional derivatives (row, column) of a rate and an output by a state and an input: offered, by differences.
NAN = float("nan")
WRONG = {
    "no number": ([[NAN, 1.0], [0.0, 2.0]], [[-3.0, 1.0], [0.0, 2.0]]),
    "no number at all": ([[NAN, NAN], [NAN, NAN]], [[-3.0, 1.0], [0.0, 2.0]]),
    "infinite": ([[-3.0, float("inf")], [0.0, 2.0]], [[-3.0, 1.0], [0.0, 2.0]]),
    "wrong beside a difference that is none": ([[-3.0, 1.0], [7.0, 2.0]], [[-3.0, 1.0], [0.0, NAN]]),
    "wrong by a sign": ([[3.0, 1.0], [0.0, 2.0]], [[-3.0, 1.0], [0.0, 2.0]]),
}
RIGHT = {
    "the same": ([[-3.0, 1.0], [0.0, 2.0]], [[-3.0, 1.0 + 1e-9], [0.0, 2.0]]),
    "where no difference can be computed": ([[-3.0, 1.0], [0.0, 2.0]], [[-3.0, 1.0], [0.0, NAN]]),
    "a row without any": ([[-3.0, 1.0], [0.0, 0.0]], [[-3.0, 1.0], [0.0, 0.0]]),
}


def checked(offered: list[list[float]], differences: list[list[float]]) -> None:
    quantities = [FmuQuantity(name, at, 1.0) for at, name in enumerate(("x", "u", "der(x)", "y"))]
    known = SimpleNamespace(arguments=quantities[:2], rows=quantities[2:])

    def slopes(_: Any, *, by_differences: bool = False) -> Any:
        return np.array(differences if by_differences else offered)

    trial._check_slopes(SimpleNamespace(slopes=slopes, reference=known), np.zeros(2))


@pytest.mark.parametrize("case", WRONG)
def test_directional_derivatives_that_are_none_are_refused(case: str) -> None:
    with raises_saying(ValueError, "directional derivative", "mended"):
        checked(*WRONG[case])


@pytest.mark.parametrize("case", RIGHT)
def test_right_directional_derivatives_are_taken(case: str) -> None:
    checked(*RIGHT[case])


def _failing_once(status: str) -> Callable[[str], str]:
    """Return a change after which the rates of large currents report a status."""
    return lambda text: text.replace(
        "return copy(own, values, count, FIRST_RATE, STATES);",
        f"if (((Instance *)own)->memory.variables[FIRST_STATE] > 1e6) {{ return {status}; }}\n"
        "    return copy(own, values, count, FIRST_RATE, STATES);",
    )


def started(folder: Path, status: str) -> tuple[FmuInstance, Any, Any]:
    """Return an instance, arguments for which it computes, and those for which it reports a status."""
    fmu = exported("dc_motor", changes={"sources/both_versions.h": _failing_once(status)})
    reference = reference_of(folder, fmu)
    instance = FmuInstance(reference)
    ordinary = np.array([[item.start for item in reference.arguments]])
    failing = ordinary.copy()
    failing[0, 0] = 2e6
    return instance, ordinary, failing


def not_called(instance: FmuInstance, arguments: Any) -> None:
    """Assert that compiled code does not call the FMU any more: the functions of its table lead nowhere."""
    for number in (calls.SET_STATES, calls.SET_REALS, calls.GET_RATES, calls.GET_REALS, calls.UPDATE):
        instance._table[number] = 0
    found = np.zeros((1, len(instance.reference.rows)))
    calls.sweep(int(instance.address), arguments, found)
    assert np.isnan(found).all()


def test_if_no_other_instance_starts_the_freed_one_is_not_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    instance, ordinary, failing = started(tmp_path, "fmi2Error")

    def refused() -> None:
        raise OSError("no licence")

    monkeypatch.setattr(instance, "_begin", refused)
    with raises_saying(RuntimeError, "motor.fmu", "no licence"):
        instance.rows(failing)
    not_called(instance, ordinary)
    with raises_saying(RuntimeError, "motor.fmu", "mended"):
        instance.rows(ordinary)


def test_after_a_fatal_error_it_is_not_called(tmp_path: Path) -> None:
    instance, ordinary, failing = started(tmp_path, "fmi2Fatal")
    with raises_saying(RuntimeError, "motor.fmu", "fatal", "mended"):
        instance.rows(failing)
    not_called(instance, ordinary)
    with raises_saying(RuntimeError, "motor.fmu", "fatal", "mended"):
        instance.rows(ordinary)


def test_an_instance_that_nobody_uses_is_freed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, and not after a fatal error, when nothing of it may be called."""
    freed: list[int] = []
    for number, status in enumerate(("fmi2Error", "fmi2Fatal")):
        folder = tmp_path / status
        folder.mkdir()
        instance, ordinary, failing = started(folder, status)
        monkeypatch.setattr(instance._own, "fmi2FreeInstance", lambda _, number=number: freed.append(number))
        instance.rows(ordinary)
        if status == "fmi2Fatal":
            with pytest.raises(RuntimeError):
                instance.rows(failing)
        del instance
        gc.collect()
    assert freed == [0]


def test_a_folder_in_use_is_not_removed(reference: FmuReference, tmp_path: Path) -> None:
    instance = FmuInstance(reference)
    (used,) = (tmp_path / "cache").rglob(reference.digest)
    os.utime(used, (0, 0))
    others = [used.with_name(f"{number:064x}") for number in range(archive.KEPT + 3)]
    left = used.with_name("new-left")
    for at, folder in enumerate([left, *others]):
        folder.mkdir()
        os.utime(folder, (at, at))
    begun = used.with_name("new-begun")
    begun.mkdir()
    archive._remove_old(used.parent, others[-1])
    assert used.is_dir()
    assert begun.is_dir()
    assert [folder.is_dir() for folder in (left, *others)] == [False] * 4 + [True] * archive.KEPT
    del instance
    gc.collect()
    archive._remove_old(used.parent, others[-1])
    assert not used.exists()
