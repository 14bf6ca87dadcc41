"""Shared by the tests of replays: the simulated motor as a CSV table, and its reports or summary."""

from itertools import islice
from pathlib import Path

import pytest

from otolith.cli.replay import replay
from otolith.health.schema import ReportDocument
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import simulate
from tests.conftest import SIGNALS

GOLDEN = Path(__file__).parents[1] / "golden" / "replays"
MACHINE = GOLDEN / "machine.toml"
PERIOD, RECORDS = 0.01, 200
HEADING = ("t", *SIGNALS)
Lines = list[list[str]]


def recorded(scenario: MotorScenario, windows: int = 5) -> Lines:
    """Cells of ``windows`` windows of the simulated motor."""
    ticks = islice(simulate(scenario), windows * RECORDS)
    return [
        [f"{index * PERIOD:.3f}", *(repr(float(tick.measured[name])) for name in SIGNALS.values())]
        for index, tick in enumerate(ticks)
    ]


def written(folder: Path, rows: Lines, heading: tuple[str, ...] = HEADING, separator: str = ",") -> Path:
    path = folder / "data.csv"
    path.write_text("\n".join(separator.join(row) for row in [list(heading), *rows]) + "\n", encoding="utf-8")
    return path


def reports(data: Path, capsys: pytest.CaptureFixture[str]) -> list[ReportDocument]:
    capsys.readouterr()
    replay(MACHINE, [data], None, as_json=True, stopped=lambda: False)
    return [ReportDocument.from_json(line) for line in capsys.readouterr().out.splitlines()]


def summed_up(data: Path, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    replay(MACHINE, [data], None, as_json=False, stopped=lambda: False)
    return capsys.readouterr().out


def values(documents: list[ReportDocument]) -> list[float | None]:
    return [document.parameters["R_a"].value for document in documents]
