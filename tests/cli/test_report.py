"""``otolith report``: one new HTML file, by the name of a machine or its file, and what cannot be written."""

import re
import resource
import signal
import sqlite3
import time
import zlib
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from otolith.cli.main import cli
from otolith.storage.history import history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError
from tests.messages import assert_says
from tests.storage.histories import MACHINE, SITE, documents


@pytest.fixture(autouse=True)
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A history of the last minutes; returns its path."""
    monkeypatch.chdir(tmp_path)
    now = time.time()
    writer = HistoryWriter(history_path(SITE, MACHINE), Bounds(20_000_000, 3650, 24))
    numbers, _ = writer.open(now)
    for report in documents(100, start=now - 200.0):
        writer.add(numbers.number(report))
    writer._write_waiting()
    writer._close()
    return writer.reader.path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["report", *arguments], standalone_mode=False)


def test_the_name_of_the_file_is_printed_and_has_machine_and_time() -> None:
    path = Path(run(MACHINE).stdout.strip())
    assert re.fullmatch(rf"{MACHINE}-\d{{4}}-\d\d-\d\dT\d{{6}}\.html", path.name)
    text = path.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert "armature" not in text  # no daemon has described this machine
    assert "R_a" in text


def test_a_machine_file_names_its_machine(tmp_path: Path) -> None:
    file = tmp_path / "press.toml"
    file.write_text(f'[machine]\nname = "{MACHINE}"\nsite = "{SITE}"\n[twin]\nname = "dc_motor"\n', encoding="utf-8")
    assert "R_a" in run(str(file), "--output", "-").stdout


def test_the_page_is_printed() -> None:
    text = run(MACHINE, "--since", "1h", "--output", "-").stdout
    assert text.rstrip().endswith("</html>")
    assert list(Path().glob("*.html")) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("press-4",), "did you mean 'press-3'"),
        ((MACHINE, "--since", "yesterday"), "write an age"),
        ((MACHINE, "--since", "9999-01-01"), "lies in the future"),
        ((MACHINE, "--output", "/dev/null"), "exists"),
    ],
)
def test_a_wrong_argument_names_the_way_out(arguments: tuple[str, ...], message: str) -> None:
    error = run(*arguments).exception
    assert isinstance(error, click.ClickException | ConfigurationError)
    assert message in getattr(error, "message", str(error))


def test_a_folder_that_is_missing_is_named(tmp_path: Path) -> None:
    error = run(MACHINE, "--output", str(tmp_path / "missing" / "report.html")).exception
    assert isinstance(error, click.BadParameter)
    assert_says(error.message, str(tmp_path / "missing"), "report.html")


def test_a_full_disk_leaves_no_part_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        error = run(MACHINE, "--output", str(path)).exception
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert isinstance(error, OSError)
    assert error.filename == str(path)
    assert not path.exists()


def test_a_history_that_is_no_database_is_named(written: Path) -> None:
    written.write_bytes(b"no database at all" * 100)
    error = run(MACHINE).exception
    assert isinstance(error, ConfigurationError)
    assert str(written) in str(error)


def test_a_document_that_cannot_be_read_is_named(written: Path) -> None:
    with sqlite3.connect(written) as connection:
        connection.execute("UPDATE report SET text = ?", (zlib.compress(b"{}"),))
    error = run(MACHINE).exception
    assert isinstance(error, ConfigurationError)
    assert "cannot be read" in str(error)


def test_the_page_is_opened_in_the_browser_if_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def open_once(address: str) -> bool:
        opened.append(address)
        return len(opened) == 1

    monkeypatch.setattr("webbrowser.open", open_once)
    path = Path(run(MACHINE, "--open", "--output", "page.html").stdout.strip())
    assert opened == [path.absolute().as_uri()]
    assert "BROWSER" in run(MACHINE, "--open", "--output", "other.html").stderr
    assert Path("other.html").exists()
    assert isinstance(run(MACHINE, "--open", "--output", "-").exception, click.UsageError)
