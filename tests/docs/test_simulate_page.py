"""The commands and the Python of docs/simulate.md do what the page says, one after the other."""

import re
import shlex
from pathlib import Path

import pytest

from otolith.simulation.prediction import Prediction
from tests.cli.commands import otolith
from tests.simulation.recorded_motor import save_learned, write_files

PAGE = (Path(__file__).parents[2] / "docs" / "simulate.md").read_text(encoding="utf-8")


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    save_learned(write_files(tmp_path))
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^    otolith (simulate .*)$", PAGE, re.MULTILINE)
    assert len(commands) == 5
    for command in commands:
        assert otolith(*shlex.split(command)).exit_code == 0
    names: dict[str, object] = {}
    for block in re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL):
        exec(block, names)  # noqa: S102 - our own page
    assert "armature resistance" in capsys.readouterr().out
    now, hot, predicted = (names[name] for name in ("now", "hot", "predicted"))
    assert isinstance(now, Prediction)
    assert isinstance(hot, Prediction)
    assert isinstance(predicted, Prediction)
    assert hot.values[-1, 1] < now.values[-1, 1]
    assert (predicted.coverage("omega") or 0.0) > 0.9
