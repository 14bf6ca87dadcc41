"""Ctrl-C ends ``otolith init`` at once, and so does the end of its input; neither leaves a file."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from otolith.cli.common import INTERRUPTED
from tests.conftest import EXAMPLES
from tests.waiting import PATIENCE

ROWS = "".join(f"{0.01 * row:.2f},{row % 7},{row % 5},{row % 9}\n" for row in range(300))
BUS = ["--dbc", str(EXAMPLES / "dc-motor.dbc"), "--interface", "virtual", "--channel", "silent", "--seconds", "600"]


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "monday.csv"
    path.write_text(f"t,u [V],i [A],omega [rad/s]\n{ROWS}", encoding="utf-8")
    return path


@contextmanager
def waiting(file: Path, options: list[str], until: bytes) -> Iterator[subprocess.Popen[bytes]]:
    """The command once it has printed ``until``; it must end within the block."""
    with subprocess.Popen(
        [sys.executable, "-m", "otolith", "init", str(file), *options],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            printed = b""
            while until not in printed:
                more = process.stdout.read1()  # type: ignore[attr-defined]
                assert more, printed
                printed += more
            yield process
        finally:
            process.kill()


def test_ctrl_c_at_a_question_ends_the_command_without_a_file(table: Path, tmp_path: Path) -> None:
    with waiting(tmp_path / "new.toml", ["--csv", str(table), "--ask"], b">") as process:
        process.send_signal(signal.SIGINT)
        shown, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == INTERRUPTED
    assert b"Traceback" not in shown
    assert list(tmp_path.iterdir()) == [table]


def test_the_end_of_the_input_at_a_question_says_that_nothing_is_written(table: Path, tmp_path: Path) -> None:
    with waiting(tmp_path / "new.toml", ["--csv", str(table), "--ask"], b">") as process:
        shown, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == INTERRUPTED
    assert b"nothing is written" in shown
    assert list(tmp_path.iterdir()) == [table]


def test_ctrl_c_while_it_listens_is_no_missing_signal(tmp_path: Path) -> None:
    with waiting(tmp_path / "new.toml", BUS, b"let the machine move") as process:
        process.send_signal(signal.SIGINT)
        shown, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == INTERRUPTED
    assert b"Error" not in shown
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_refused_before_anything_is_read(table: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "otolith", "init", str(tmp_path / "none" / "new.toml"), "--csv", str(table)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 2
    assert "folder" in done.stderr
    assert done.stdout == ""
