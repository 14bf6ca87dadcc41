"""The guide docs/from-a-log-to-a-monitored-machine.md on the measured logs: its commands run, its figures are found.

The logs are not part of this project: the tests read ``rotor_rig`` and ``servo_pendulum`` from OTOLITH_DATA or
../shared/data, unchanged.
"""

import os
import re
import shlex
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from otolith.acquisition.window import Array
from otolith.cli.main import cli
from otolith.cli.noise import identified_noise
from otolith.discovery.decision import WindowDecision
from otolith.health.schema import ReportDocument
from otolith.machine import load_machine, load_twin
from otolith.runtime.replay import Replay, open_recorded
from otolith.twin.identifiability import structural_identifiability

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "docs" / "from-a-log-to-a-monitored-machine.md").read_text(encoding="utf-8")
PLACES = [*map(Path, filter(None, [os.environ.get("OTOLITH_DATA")])), ROOT.parent / "shared" / "data"]
DATA = next((place for place in PLACES if (place / "rotor_rig").is_dir() and (place / "servo_pendulum").is_dir()), None)
needs_data = pytest.mark.skipif(
    DATA is None, reason="rotor_rig and servo_pendulum are not part of this project: put them into OTOLITH_DATA"
)

ROTOR_LOGS = ("healthy_100", "healthy_104", "damping_420", "damping_424")
SERVO_LOGS = tuple(
    f"{motion}_kp{gain}"
    for motion in ("lift_and_drop", "sin_sin", "sin_time_square", "up_and_down")
    for gain in (100, 400)
)
KP_100 = 'gain = "0.2877 1/rad"'
AT_REST = 0.02  # rad: an arm that moves by less within a window is at rest
USED = 0.95  # share of the windows with motion
DAMPING = 0.05  # largest error of the damping of a window
NOISE = 0.5  # largest error of a noise level on the page


def logs(name: str) -> Path:
    assert DATA is not None
    return DATA / name


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the guide, with those of kp 100 as it says, beside the logs."""
    place = tmp_path_factory.mktemp("guide")
    for name, text in re.findall(r"<!-- file: (\S+) -->\n```toml\n(.*?)```", GUIDE, re.DOTALL):
        (place / name).write_text(text, encoding="utf-8")
    assert KP_100 in GUIDE
    text = (place / "servo-kp400.toml").read_text(encoding="utf-8")
    (place / "servo-kp100.toml").write_text(re.sub(r'gain = ".*?"', KP_100, text), encoding="utf-8")
    if DATA is not None:
        for name in ("rotor_rig", "servo_pendulum"):
            for log in logs(name).glob("*.csv"):
                shutil.copy(log, place)
    return place


_REPORTS: dict[tuple[str, str], list[ReportDocument]] = {}


def reports(folder: Path, machine: str, log: str) -> list[ReportDocument]:
    """Reports on a log; each log is replayed once for all tests."""
    if (machine, log) not in _REPORTS:
        loaded = load_machine(folder / machine, with_driver=False)
        with open_recorded(loaded, folder / f"{log}.csv") as recorded:
            _REPORTS[machine, log] = [report.document for report in Replay(loaded, recorded).reports()]
    return _REPORTS[machine, log]


@cache
def table(log: Path) -> dict[str, Array]:
    """Columns of a log by their names without units; the time is in seconds."""
    names = re.findall(r"[^,]+", log.read_text(encoding="utf-8").split("\n", 1)[0])
    values = np.loadtxt(log, delimiter=",", skiprows=1)
    columns = {name.split(" ")[0]: values[:, index] for index, name in enumerate(names)}
    if "t [ms]" in names:
        columns["t"] = columns["t"] / 1000.0
    return columns


def refused(documents: list[ReportDocument]) -> list[str]:
    """What was said of the windows that do not update the estimates."""
    return [
        f"window {document.window.index}: {document.decision}: {next(iter(document.parameters.values())).reason}"
        for document in documents
        if document.decision is not WindowDecision.LEARNED
    ]


@pytest.mark.parametrize(("twin", "free"), [("rotor", ("inertia", "damping")), ("servo-pendulum", ("k_m", "share"))])
def test_the_twins_are_read(folder: Path, twin: str, free: tuple[str, ...]) -> None:
    definition = load_twin(folder / f"{twin}.toml")
    identifiable = {row.name: row.identifiable for row in structural_identifiability(definition)}
    assert set(free) <= set(identifiable)
    if twin == "rotor":
        assert all(identifiable.values())


@needs_data
def test_the_columns_are_those_of_the_logs(folder: Path) -> None:
    shown = re.findall(r"<!-- log: (\S+) -->\n```\n(.*?)\n```", GUIDE)
    assert len(shown) == 2
    for log, heading in shown:
        assert logs(log).read_text(encoding="utf-8").startswith(heading + "\n")


@needs_data
def test_every_command_of_the_guide_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    commands = [line for line in re.findall(r"^    otolith (.*)$", GUIDE, re.MULTILINE) if "my-machine" not in line]
    assert {command.split()[0] for command in commands} >= {"twin", "noise", "replay"}
    for command in commands:
        result = CliRunner().invoke(cli, shlex.split(command))
        assert result.exit_code == 0, (command, result.output, result.exception)


@needs_data
@pytest.mark.parametrize(("machine", "log"), [("rotor-rig", "healthy_104"), ("servo-kp400", "sin_time_square_kp400")])
def test_noise_levels_of_the_guide_are_identified(folder: Path, machine: str, log: str) -> None:
    loaded = load_machine(folder / f"{machine}.toml", with_driver=False)
    _, levels = identified_noise(loaded, folder / f"{log}.csv", 30)
    written = dict(zip((state.name for state in loaded.twin.states), loaded.problem.process_noise, strict=True))
    for level in levels.states:
        assert level.value == pytest.approx(written[level.name], rel=NOISE)


@needs_data
@pytest.mark.parametrize("log", ROTOR_LOGS)
def test_every_window_of_the_rotor_is_good(folder: Path, log: str) -> None:
    documents = reports(folder, "rotor-rig.toml", log)
    times = table(folder / f"{log}.csv")["t"]
    moving = times[np.flatnonzero(np.diff(times) > 2.0)[-1] + 1 :] if np.diff(times).max() > 2.0 else times
    assert len(documents) == int((moving[-1] - moving[0]) / 2.0)
    assert [document.window.quality.reasons for document in documents if document.window.quality.reasons] == []
    assert all(document.fit is not None for document in documents)


@needs_data
@pytest.mark.parametrize("log", ["healthy_100", "healthy_104"])
def test_a_healthy_rotor_is_learned_from(folder: Path, log: str) -> None:
    documents = reports(folder, "rotor-rig.toml", log)
    assert refused(documents) == []
    assert not any(document.findings for document in documents)
    columns = table(folder / f"{log}.csv")
    expected = columns["control_effort"][2:].mean() / columns["speed"][2:].mean()
    assert documents[-1].parameters["damping"].value == pytest.approx(expected, rel=DAMPING)


@needs_data
@pytest.mark.parametrize("log", ["damping_420", "damping_424"])
def test_each_window_alone_shows_the_damper(folder: Path, log: str) -> None:
    columns = table(folder / f"{log}.csv")
    checked = 0
    for document in reports(folder, "rotor-rig.toml", log):
        inside = (columns["t"] >= document.window.start) & (columns["t"] < document.window.end)
        labels = set(columns["damper_ohm"][inside])
        if len(labels) > 1:
            continue
        stretch = columns["damper_ohm"] == labels.pop()
        expected = columns["control_effort"][stretch].mean() / columns["speed"][stretch].mean()
        assert document.parameters["damping"].raw == pytest.approx(expected, rel=DAMPING)
        checked += 1
    assert checked >= 6


@needs_data
def test_the_guide_shows_the_damping_of_each_stretch() -> None:
    (log,) = re.findall(r"<!-- stretches: (\S+) -->", GUIDE)
    columns = table(logs(log))
    rows = re.findall(r"^\| (\d+) ohm \| ([\d.]+) \| ([\d.]+) \|$", GUIDE, re.MULTILINE)
    assert len(rows) == 3
    for label, alone, mean in rows:
        stretch = columns["damper_ohm"] == float(label)
        expected = columns["control_effort"][stretch].mean() / columns["speed"][stretch].mean()
        assert float(mean) == pytest.approx(expected, abs=5e-5)
        assert float(alone) == pytest.approx(expected, rel=0.01)


@needs_data
def test_windows_of_the_servo_with_motion_are_used(folder: Path) -> None:
    moving, problems = 0, []
    for log in SERVO_LOGS:
        columns = table(folder / f"{log}.csv")
        documents = reports(folder, f"servo-{log[-5:]}.toml", log)
        assert len(documents) >= 2
        for document in documents:
            inside = (columns["t"] >= document.window.start) & (columns["t"] < document.window.end)
            if np.ptp(columns["position"][inside]) > AT_REST:
                moving += 1
                problems += [f"{log}, {text}" for text in refused([document])]
    assert moving >= 18
    assert len(problems) <= (1.0 - USED) * moving, "\n".join(problems)


@needs_data
def test_the_gain_of_the_guide_is_that_of_the_manual(folder: Path) -> None:
    for gain in (100, 400):
        known = dict(load_machine(folder / f"servo-kp{gain}.toml", with_driver=False).problem.known)
        assert known["gain"] == pytest.approx(gain * 4096 / (2 * np.pi) / (256 * 885), rel=1e-3)
