"""CAN logs of other tools: candump on the screen, CSV of SavvyCAN and python-can, SQLite; refusals name the format."""

import base64
import gc
import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from random import Random

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.errors import ConfigurationError, installation_of
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay import mf4
from otolith_drivers.replay.readers import HEAD, OTHERS, TEXT_LOGS, Rows, holds_frames, seen, text_log
from otolith_drivers.replay.table.reader import TableReader
from tests.drivers import logs
from tests.drivers.logs import frames_of, live, opened, samples_of
from tests.messages import assert_refuses

Frames = list[can.Message]
MF4_WRITER = """
import can
with can.MF4Writer("bus.mf4") as writer:
    for frame in can.CanutilsLogReader("bus.log"):
        writer(frame)
"""
SIGNAL_WRITER = """
from asammdf import MDF, Signal
file = MDF()
file.append([Signal([1.0], [0.0], name="Speed")])
file.save("s.mf4")
"""
SCHEMA = """CREATE TABLE messages (ts REAL, arbitration_id INTEGER, extended INTEGER, remote INTEGER, error INTEGER,
dlc INTEGER, data BLOB)"""


def spaced(frame: can.Message) -> str:
    return frame.data.hex(" ").upper()


def candump(frames: Frames, *, date: bool = False, colour: bool = False) -> str:
    lines = []
    for frame in frames:
        moment = datetime.fromtimestamp(frame.timestamp, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
        time = moment if date else f"{frame.timestamp:.6f}"
        text = f" ({time})  can0  {frame.arbitration_id:03X}   [{frame.dlc}]  {spaced(frame)}"
        lines.append(f"\x1b[31m{text}\x1b[0m" if colour else text)
    return "\n".join([*lines, ""])


def candump_log(frame: can.Message) -> str:
    return f"({frame.timestamp:.6f}) can0 {frame.arbitration_id:03X}#{frame.data.hex()}\n"


def verbose(frames: Frames) -> str:
    """With the flags of ``candump -x`` and the characters of ``-a``."""
    return candump(frames).replace("  can0  ", "  can0  RX - -  ").replace("\n", "   '.{.}'\n")


def savvycan(frames: Frames, *, direction: bool = True) -> str:
    names = [
        "Time Stamp",
        "ID",
        "Extended",
        *(["Dir"] if direction else []),
        "Bus",
        "LEN",
        *(f"D{n}" for n in range(1, 9)),
    ]
    lines = [",".join(names)]
    for frame in frames:
        head = [
            f"{frame.timestamp * 1e6:.0f}",
            f"{frame.arbitration_id:08X}",
            "false",
            *(["Rx"] if direction else []),
            "0",
        ]
        lines.append(",".join([*head, str(frame.dlc), *spaced(frame).split()]) + ",")
    return "\n".join([*lines, ""])


def python_can(frames: Frames) -> str:
    lines = ["timestamp,arbitration_id,extended,remote,error,dlc,data"]
    for frame in frames:
        data = base64.b64encode(bytes(frame.data)).decode()
        lines.append(f"{frame.timestamp!r},{hex(frame.arbitration_id)},0,0,0,{frame.dlc},{data}")
    return "\n".join([*lines, ""])


WRITERS: dict[str, tuple[str, Callable[[Frames], str]]] = {
    "candump -ta": ("bus.log", candump),
    "candump -tA": ("bus.txt", lambda frames: candump(frames, date=True)),
    "candump -c": ("bus.log", lambda frames: candump(frames, colour=True)),
    "candump -x -a": ("bus", verbose),
    "SavvyCAN": ("bus.csv", savvycan),
    "SavvyCAN, older": ("bus.csv", lambda frames: savvycan(frames, direction=False)),
    "python-can": ("bus.csv", python_can),
}


@pytest.fixture
def frames(scenario: MotorScenario) -> Frames:
    return frames_of(scenario, 200)


def read(path: Path) -> tuple[list[Rows], str, list[str]]:
    with opened(path) as log:
        rows = list(log.chunks())
        return rows, ", ".join(log.summary_lines()), log.warnings()


def written(folder: Path, frames: Frames, kind: str) -> Path:
    if kind == "SQLite":
        path = folder / "bus.db"
        rows = [(one.timestamp, one.arbitration_id, 0, 0, 0, one.dlc, memoryview(one.data)) for one in frames]
        with closing(sqlite3.connect(path)) as database, database:  # python-can's writer loses the last frames
            database.execute(SCHEMA)
            database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
        return path
    if kind == "MF4":  # python-can's writer, which otolith keeps from importing asammdf in this process
        (folder / "bus.log").write_text("".join(map(candump_log, frames)), encoding="utf-8")
        subprocess.run([sys.executable, "-c", MF4_WRITER], cwd=folder, check=True)
        return folder / "bus.mf4"
    name, text = WRITERS[kind]
    (folder / name).write_text(text(frames), encoding="utf-8")
    return folder / name


@pytest.mark.parametrize("kind", [*WRITERS, "SQLite", "MF4"])
def test_samples_equal_live_samples(tmp_path: Path, frames: Frames, kind: str) -> None:
    path = written(tmp_path, frames, kind)
    assert holds_frames(path)
    rows, summary, warnings = read(path)
    assert samples_of(rows) == [(sample.signal, sample.value) for sample in live(frames)]
    times = np.concatenate([part.times for part in rows])
    expected = [frame.timestamp for frame in frames if frame.arbitration_id != 0x7FF]
    assert times == pytest.approx(np.array(expected), abs=2e-6)
    assert f"{len(frames)} frames read, 200 of other messages, 0 bad" in summary
    assert ["UTC" in line for line in warnings] == [True] * (kind == "candump -tA")  # a date without a zone


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("candump -ta", " (1700000001.5)  can0  181   [8]  01 02"),
        ("candump -ta", " (never)  can0  181   [8]  01 02 03 04 05 06 07 08"),
        ("candump -ta", f" (1700000001.5)  can0  181   [8]  {'00000001 ' * 8}"),  # candump -i: bits instead of bytes
        ("SavvyCAN", "1700000001500000,00000181,false,Rx,0,8,01,02"),
        ("SavvyCAN", "soon,00000181,false,Rx,0,1,01"),
        ("python-can", "1700000001.5,0x181,0,0,0,8"),
        ("python-can", "1700000001.5,0x181,0,0,0,8,!"),
    ],
)
def test_a_damaged_line_is_counted_and_located(tmp_path: Path, frames: Frames, kind: str, line: str) -> None:
    path = written(tmp_path, frames, kind)
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([*lines[:101], line, *lines[101:], ""]), encoding="utf-8")
    rows, summary, warnings = read(path)
    assert sum(len(part.times) for part in rows) == len(live(frames)) // 2
    assert "1 bad" in summary
    assert "line 102:" in warnings[0]


def test_error_remote_extended_and_fd_frames_of_candump_are_distinguished(tmp_path: Path, frames: Frames) -> None:
    others = (
        " (1700000000.000000)  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n"
        " (1700000000.000000)  can0  181   [8]  remote request\n"
        " (1700000000.000000)  can0  00000181   [8]  FF FF FF FF FF FF FF FF\n"
        f" (1700000000.000000)  can0  7F0  [64]  {'00 ' * 64}\n"
    )
    path = tmp_path / "bus.log"
    path.write_text(others + candump(frames), encoding="utf-8")
    rows, summary, _ = read(path)
    assert samples_of(rows) == [(sample.signal, sample.value) for sample in live(frames)]
    assert f"{len(frames) + 4} frames read, 204 of other messages, 0 bad" in summary


def test_differences_are_refused_in_the_compact_form_too(tmp_path: Path) -> None:
    """A node that sends two frames every 10 ms, and a computer whose times scatter."""
    generator = np.random.default_rng(1)
    steps = [step for scatter in generator.normal(0.0, 1e-4, 100) for step in (0.0098 + scatter, 0.0002)]
    log = "".join(f"({step:.6f}) can0 181#E803D00700000000\n" for step in steps)
    path = tmp_path / "bus.log"
    path.write_text(log, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="candump -td"):
        read(path)


def test_logs_of_other_tools_are_named_below_their_title(tmp_path: Path) -> None:
    spy = "Spy Setup File,x\n\nLine,Abs Time(Sec),Status,Tx,Description,Arb ID,Xtd,B1,B2\n1,2,3,F,x,064,F,F0,00\n"
    kvaser = "  Memorator Log\n  ====\n\n  Time Chan Identifier Flags DLC Data\n"
    for name, text in (("spy.csv", spy), ("kvaser.txt", kvaser)):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigurationError, match="candump -L"), TableReader(path, {"x": "1"}) as reader:
            list(reader.chunks())


def test_times_that_are_differences_are_refused(tmp_path: Path, frames: Frames) -> None:
    lines, before = [], frames[0].timestamp
    for frame in frames:
        lines.append(f" ({frame.timestamp - before:010.6f})  can0  {frame.arbitration_id:03X}   [8]  {spaced(frame)}\n")
        before = frame.timestamp
    path = tmp_path / "bus.log"
    path.write_text("".join(lines), encoding="utf-8")
    with pytest.raises(ConfigurationError, match="candump -td"):
        read(path)


@pytest.mark.parametrize("name", ["bus.db", "bus.blf"])
@pytest.mark.parametrize(
    ("start", "kind"), [(b"MDF     4.10", "MF4"), (b"PK\x03\x04", "ZIP"), (b"\x89HDF\r\n", "HDF5")]
)
def test_a_refusal_names_the_format(tmp_path: Path, name: str, start: bytes, kind: str) -> None:
    path = tmp_path / name
    path.write_bytes(start + bytes(2000))
    with pytest.raises(ConfigurationError, match=kind):
        read(path)


@pytest.mark.parametrize(
    ("name", "line", "kind"),
    [
        ("bus.log", "  can0  123   [8]  00 00 F4 01 00 00 00 00", "candump without times"),
        ("bus.csv", "Time,Channel,ID,Flags,DLC,Data0,Data1", "CAN log of another tool"),
        ("bus.txt", "Timestamp;Type;ID;Data", "CAN log of another tool"),
        ("bus.csv", "Time[s],Send Type,CAN ID,Direction,Data Length,Data Bytes", "CAN log of another tool"),
        ("bus.txt", "Chn Identifier Flg   DLC  D0...1...2...3", "CAN log of another tool"),
        ("bus.csv", "t,omega,id,kind", "no column 'x' \\(1\\): known: id, kind, omega$"),
    ],
)
def test_a_refusal_of_a_text_names_the_log_that_it_seems_to_be(tmp_path: Path, name: str, line: str, kind: str) -> None:
    path = tmp_path / name
    path.write_text(f"{line}\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=kind):
        _ = read(path) if name == "bus.log" else TableReader(path, {"x": "1"})


@pytest.mark.parametrize("name", ["bus.trc", "bus.asc", "bus.csv", "bus.log", "bus"])
@pytest.mark.parametrize("kind", ["savvycan", ".asc", ".trc"])
def test_a_text_log_is_recognised_whatever_its_name(tmp_path: Path, frames: Frames, kind: str, name: str) -> None:
    path = tmp_path / name
    if kind == "savvycan":
        path.write_text(savvycan(frames), encoding="utf-8")
    else:
        logs.written(tmp_path, frames, kind).rename(path)
    assert holds_frames(path)
    rows, summary, _ = read(path)
    assert samples_of(rows) == [(sample.signal, sample.value) for sample in live(frames)]
    assert " 0 bad" in summary


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("bus.asc", "date Wed\nbase hex\n".encode("utf-16"), "no frames \\(it looks like UTF-16 text\\)"),
        ("bus.asc", b"PAR1", "no frames \\(it looks like Parquet\\)"),
        ("bus.log", b"\x0a\x0d\x0d\x0a\x1c", "looks like a capture of network packets"),
        ("bus.log", b"1795564000.000000 R11 181 40 1F\n", "looks like a CAN log of another tool"),
        ("bus.log", b"t1818401FF9FF00000000\n", "looks like a CAN log of another tool"),
        ("bus.log", b" 0    00000181         8  40  1F  F9  FF  00  00  00  00    0.01 R\n", "CAN log of another tool"),
    ],
)
def test_a_log_without_frames_names_the_format(tmp_path: Path, name: str, content: bytes, kind: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigurationError, match=kind):
        read(tmp_path / name)


def test_a_database_without_frames_and_with_damaged_rows_is_no_traceback(tmp_path: Path, frames: Frames) -> None:
    path = written(tmp_path, frames, "SQLite")
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("INSERT INTO messages VALUES (NULL, 'x', 0, 0, 0, 8, NULL)")
        database.execute("INSERT INTO messages VALUES ('now', 385, 0, 0, 0, 8, 3)")
    _, summary, _ = read(path)
    assert "2 bad" in summary
    empty = tmp_path / "other.db"
    with closing(sqlite3.connect(empty)) as database, database:
        database.execute("CREATE TABLE customers (name TEXT)")
    with pytest.raises(ConfigurationError, match="no such table: messages"):
        read(empty)
    damaged = tmp_path / "damaged.db"
    damaged.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ConfigurationError, match="damaged"):
        read(damaged)


# asammdf fails once more when a file that it could not open is freed.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_mf4_file_of_signals_names_them_and_a_damaged_one_is_no_traceback(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", SIGNAL_WRITER], cwd=tmp_path, check=True)
    with pytest.raises(ConfigurationError, match=r"signals \(Speed\) and no CAN frames"):
        read(tmp_path / "s.mf4")
    damaged = tmp_path / "damaged.mf4"
    damaged.write_bytes((tmp_path / "s.mf4").read_bytes()[:200])
    with pytest.raises(ConfigurationError, match="damaged or cut off"):
        read(damaged)
    gc.collect()


READ_MF4 = """
import sys
from pathlib import Path
from otolith_drivers.replay.mf4 import Mf4Frames
for path in map(Path, sys.argv[1:]):
    texts = [text for _, text in Mf4Frames(path, b"MDF ").frames() if isinstance(text, str)]
    print(*map(repr, texts or ["whole"]))
"""


def test_of_a_damaged_mf4_file_the_library_prints_nothing(tmp_path: Path, frames: Frames) -> None:
    path, random = written(tmp_path, frames[:300], "MF4"), Random(1)  # noqa: S311 - damage, not a secret
    content, paths = path.read_bytes(), [path]
    for number in range(40):
        damaged = bytearray(content[: random.randrange(64, len(content))] if number % 2 else content)
        for _ in range(number % 3):
            damaged[random.randrange(64, min(len(damaged), 3000))] = random.randrange(256)
        paths.append(tmp_path / f"{number}.mf4")
        paths[-1].write_bytes(damaged)
    child = subprocess.run([sys.executable, "-c", READ_MF4, *paths], capture_output=True, text=True, check=True)
    assert child.stderr == ""
    first, *lines = child.stdout.splitlines()
    assert first == "'whole'"
    assert len(lines) == 40
    assert sum("damaged or cut off" in line for line in lines) > 10
    assert all("Traceback" not in line and len(line) < 1000 for line in lines)


def test_a_missing_library_for_mf4_is_named_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bus.mf4").write_bytes(b"MDF     4.10")
    monkeypatch.setattr(mf4, "find_spec", lambda _: None)
    with pytest.raises(ConfigurationError, match=re.escape(installation_of("mf4"))):
        read(tmp_path / "bus.mf4")


def test_python_can_does_not_import_asammdf() -> None:
    modules = "otolith_drivers.replay.can_log, otolith_drivers.plant.can_node"
    code = f"import sys, {modules}; sys.exit('asammdf' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["table.csv", "table.txt"])
def test_a_table_stays_a_table(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("t,i,omega\n0,1,2\n", encoding="utf-8")
    assert not holds_frames(path)
    assert not holds_frames(tmp_path / "absent.csv")


@given(st.binary(max_size=400))
def test_no_content_raises(head: bytes) -> None:
    assert seen(head) in {"", *OTHERS, *TEXT_LOGS}
    assert text_log(head) in {"", *TEXT_LOGS}
    assert len(head) < HEAD


@given(data=st.data(), kind=st.sampled_from(sorted(WRITERS)))
def test_changed_bytes_end_nothing(tmp_path: Path, frames: Frames, data: st.DataObject, kind: str) -> None:
    path = written(tmp_path, frames[:20], kind)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 30))):
        content[data.draw(st.integers(len(content) // 4, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        with opened(path) as log:
            used = sum(len(rows.times) for rows in log.chunks())
    except ConfigurationError as error:
        assert_refuses(error, path)
        return
    found, others, bad = (int(line.split()[0]) for line in log.summary_lines()[:3])
    assert used + others <= found <= used + others + bad
    assert found >= 20 or len(log.summary_lines()) > 3 or bad or log.warnings()
