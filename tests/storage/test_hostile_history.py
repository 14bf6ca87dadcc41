"""A history from elsewhere costs neither hours nor gigabytes, whatever is in it, and no traceback."""

import resource
import shutil
import sqlite3
import subprocess
import sys
import time
import zlib
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner

from otolith.cli.main import cli
from otolith.storage import history_safety
from otolith.storage.history import KEPT, SUFFIX, WINDOW, HistoryReader
from otolith.storage.history_schema import SCHEMA_VERSION
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError
from tests.messages import raises_saying
from tests.storage.histories import MACHINE, SITE, START
from tests.waiting import within

SOURCE = Path(__file__).parents[1] / "golden" / "histories" / "4.sqlite"
"""Its tables take any value, and so do those of a file that says of itself that it is of the present version."""
MEMORY = 1_500 << 20  # bytes of addresses: the imports of a command take half of them, the attacks more than all
ENDLESS = "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r)"
VIEWS = {
    "identity": f"DROP TABLE identity; CREATE VIEW identity AS {ENDLESS} SELECT 'hall-1' AS site, n AS machine FROM r",  # noqa: S608 - our own text
    "sample": f"DROP TABLE sample; CREATE VIEW sample AS {ENDLESS} SELECT 0 AS resolution, n AS time FROM r",  # noqa: S608 - as above
    "another": f"CREATE VIEW more AS {ENDLESS} SELECT n FROM r",  # noqa: S608 - as above
}
COMPUTED = {
    "column": "ALTER TABLE event ADD COLUMN more TEXT AS (hex(zeroblob(1000000000)))",
    "index": "CREATE INDEX more ON event (hex(zeroblob(100)))",
    "trigger": "CREATE TRIGGER more AFTER INSERT ON report BEGIN DELETE FROM event; END",
    "virtual table": "CREATE VIRTUAL TABLE more USING fts5(text)",
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    copy = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    shutil.copy(SOURCE, copy)
    change(copy, f"PRAGMA user_version = {SCHEMA_VERSION}")
    return copy


def change(path: Path, script: str, *values: object) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        if values:
            connection.execute(script, values)
        else:
            connection.executescript(script)


def bomb() -> bytes:
    """A report of 2 GB in 2 MB."""
    packing, spaces = zlib.compressobj(9), bytes(1 << 24)
    return b"".join([*(packing.compress(spaces) for _ in range(120)), packing.flush()])


@pytest.mark.parametrize("name", ["view", "bomb"])
def test_a_command_ends_soon_and_in_little_memory(path: Path, name: str) -> None:
    if name == "view":
        change(path, VIEWS["identity"])
    else:
        change(path, "UPDATE report SET text = ?", bomb())
    limits = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = f"ulimit -v {MEMORY >> 10}; ulimit -t 30; exec {sys.executable} -m otolith report {path} --output -"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)  # noqa: S602 - our own text
    seconds = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - limits.ru_utime
    assert done.returncode == 2
    *before, last = done.stderr.splitlines()
    assert last.startswith("Error: ")
    assert path.name in last
    assert len(before) == (name == "bomb")  # what was left out
    assert seconds < 15.0


@pytest.mark.parametrize("name", [*VIEWS, *COMPUTED])
def test_what_is_computed_is_refused_and_set_aside(path: Path, name: str) -> None:
    change(path, {**VIEWS, **COMPUTED}[name])
    for read in (HistoryReader(path).labels, lambda: HistoryReader.of_file(path)):
        with pytest.raises(ConfigurationError, match=r"no history has"):
            read()
    writer = HistoryWriter(path, Bounds(20_000_000, 3650, 24))
    _, note = writer.open(START)
    writer._close()
    assert "no history has" in note
    assert len(list(path.parent.glob(f"*{KEPT}"))) == 1


def test_a_text_that_unpacks_to_much_is_left_out(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    change(path, "UPDATE report SET text = ? WHERE sequence = (SELECT max(sequence) FROM report)", bomb())
    assert len(HistoryReader(path).latest(100)) == 11
    assert len(HistoryReader(path).messages("report", 100)) == 11
    assert caplog.text.count("1 rows") == 2
    change(path, "UPDATE report SET text = substr(text, 1, 100)")
    with raises_saying(ConfigurationError, path.name, "damaged"):
        HistoryReader(path).latest(100)


def test_reports_that_unpack_to_much_together_are_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = HistoryReader(path)
    size = sum(len(text.encode()) for text in reader.messages("report", 100))
    monkeypatch.setattr(history_safety, "MAX_TEXT_BYTES", size - 1)
    with raises_saying(ConfigurationError, "reports", "MB"):
        reader.latest(100)


def test_more_rows_than_anybody_reads_are_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_safety, "MAX_ROWS", 5)
    with raises_saying(ConfigurationError, path.name, "--since"):
        HistoryReader(path).samples(WINDOW, 0.0)


@pytest.mark.timed
def test_a_query_has_a_time(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_safety, "QUERY_TIME", 0.1)
    begun = time.monotonic()
    with raises_saying(ConfigurationError, path.name, "takes longer"):
        HistoryReader(path)._rows(f"{ENDLESS} SELECT max(n) FROM r")  # noqa: S608 - our own text
    assert time.monotonic() - begun < within(1.0)


def test_a_value_that_a_query_would_make_has_a_size(path: Path) -> None:
    with raises_saying(ConfigurationError, path.name, "too big"):
        HistoryReader(path)._rows("SELECT hex(zeroblob(1000000000))")


DEEP = "[" * 100_000
VALUES: dict[str, tuple[str, object]] = {
    "deep description": ("UPDATE description SET text = ?", DEEP),
    "description of another shape": ("UPDATE description SET text = ?", '{"limits": 5, "equations": 7, "sites": []}'),
    "limits of another shape": ("UPDATE description SET text = ?", '{"limits": {"R_a": [["BAD", "x", 3]]}}'),
    "deep finding": ("UPDATE finding SET text = ?", DEEP),
    "finding without text": ("UPDATE finding SET text = ?", "{}"),
    "finding in no year": ("UPDATE finding SET last = ?", 1e300),
    "event that is a number": ("UPDATE event SET text = ?", 7),
    "event in no year": ("UPDATE event SET time = ?", 1e300),
    "deep event": ("UPDATE event SET text = ?", DEEP),
    "value that is a text": ("UPDATE sample SET mean = ?", "much"),
    "value without end": ("UPDATE sample SET last = ?", float("inf")),
    "value in no year": ("UPDATE sample SET time = time * ?", 1e290),
    "value of a text that is none": ("UPDATE sample SET status = ?", b"\xff\xfe"),
    "counters of another shape": ("UPDATE counters SET text = ?", "[]"),
    "counters in no year": ("UPDATE counters SET hour = ?", 1e300),
    "run that is a text": ("UPDATE counters SET run = ?", "first"),
    "state in no year": ("UPDATE state SET entered = ?", 1e300),
    "state that is none": ("UPDATE state SET state = ?", "FINE"),
    "label in no year": ("INSERT INTO label VALUES (0, ?)", 1e300),
    "report that is no report": ("UPDATE report SET text = ?", zlib.compress(DEEP.encode())),
    "report in no year": ("UPDATE report SET time = ?", 1e300),
}


@pytest.mark.parametrize("name", VALUES)
def test_no_value_gives_a_traceback(path: Path, name: str) -> None:
    change(path, *VALUES[name])
    since = time.strftime("%F", time.gmtime(START - 86_400.0))
    commands = [["history", "--events"], ["history"], ["history", "--json"], ["history", "--csv", "--every", "window"],
                ["report", "--output", "-"]]  # fmt: skip
    for command, *options in commands:
        done = CliRunner().invoke(cli, [command, str(path), "--since", since, *options], standalone_mode=False)
        assert done.exception is None or isinstance(done.exception, ConfigurationError), (command, options)
