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
from numpy.typing import NDArray

from otolith.acquisition.window import Array
from otolith.cli.main import cli
from otolith.commissioning.identification import identify_noise
from otolith.discovery.alternatives import WindowDecision
from otolith.health.observations import SENSORS
from otolith.health.schema import ReportDocument
from otolith.health.text import finding_text
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
ROTOR_WINDOW = 0.8  # s
EVENT_WITHIN = 5.0  # s after a change that passes a limit
SETTLED = 3  # windows after a change: from then on the published damping is the new one
DAMPING = 0.05  # largest error of the damping of a window
BENCH = {"K": 0.047, "J": 8e-5, "T_c": 0.0085}  # of the simulated motor; R is 5 ohm, as its file says
COUNTS, ROW = 400, 0.02  # of its encoder per turn; s between its rows
STEPS = 200  # of the simulation between two rows
FIGURE = 0.03  # largest error of a figure on the page: that of two or three digits


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
    write_bench_log(place / "bench.csv")
    write_bench_log(place / "worn.csv", worn=0.0125)
    if DATA is not None:
        for name in ("rotor_rig", "servo_pendulum"):
            for log in logs(name).glob("*.csv"):
                shutil.copy(log, place)
    return place


def write_bench_log(path: Path, seconds: float = 40.0, worn: float | None = None) -> None:
    """A simulated motor as a microcontroller logs it; its dry friction is ``worn`` (N*m) in the second half."""
    random = np.random.default_rng(1)
    step = ROW / STEPS
    speed = angle = duty = 0.0
    before, rows = 0, ["time,pwm,rpm"]
    for row in range(round(seconds / ROW)):
        counts = int(angle / (2.0 * np.pi) * COUNTS)
        duty = float(random.integers(70, 221)) if row % 40 == 0 else duty
        rows.append(f"{row * ROW:.3f},{duty:.0f},{(counts - before) / COUNTS / ROW * 60.0:.1f}")
        before = counts
        dry = worn if worn is not None and row * ROW >= 0.5 * seconds else BENCH["T_c"]
        for _ in range(STEPS):
            torque = BENCH["K"] * (duty / 255.0 * 12.0 - BENCH["K"] * speed) / 5.0
            stopping = torque + BENCH["J"] * speed / step
            speed += step * (torque - min(max(stopping, -dry), dry)) / BENCH["J"]
            angle += step * speed
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


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
    twin, problem = loaded.twin, loaded.problem
    with open_recorded(loaded, folder / f"{log}.csv") as recorded:
        levels = identify_noise(problem, list(Replay(loaded, recorded).windows()))
    process = dict(zip((state.name for state in twin.states), problem.process_noise, strict=True))
    sensors = dict(zip((output.name for output in twin.outputs), problem.noise, strict=True))
    for identified, written in ((levels.states, process), (levels.outputs, sensors)):
        for level in identified:
            assert level.value == pytest.approx(written[level.name], rel=FIGURE)


@pytest.mark.full
@needs_data
def test_the_swing_of_the_guide_is_named_and_is_no_delay(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ((key, period),) = re.findall(r"`structure: (\S+)`, again every ([\d.]+) s", GUIDE)
    (delay,) = re.findall(r"a delay of `speed` of (\d+) ms would explain as much", GUIDE)
    text = printed(folder, "noise rotor-rig.toml healthy_104.csv", monkeypatch)
    ((named, measured),) = re.findall(r"^# structure: (\S+): .* again every ([\d.]+) s$", text, re.MULTILINE)
    assert named == key
    assert float(measured) == pytest.approx(float(period), rel=FIGURE)
    assert "{ delay" not in text
    (refused,) = re.findall(r"^# speed: a delay of ([\d.]+) ms would explain as much", text, re.MULTILINE)
    assert float(refused) == pytest.approx(float(delay), rel=FIGURE)
    assert "no delay is significant" in printed(folder, "noise servo-kp400.toml sin_time_square_kp400.csv", monkeypatch)


def printed(folder: Path, command: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Standard output of a command of the guide, in the folder of its files."""
    monkeypatch.chdir(folder)
    result = CliRunner().invoke(cli, shlex.split(command))
    assert result.exit_code == 0, result.output
    return result.stdout


@needs_data
def test_the_preview_is_printed_as_shown(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = printed(folder, "check rotor-rig.toml damping_424.csv", monkeypatch)
    lines = text[text.index("damping_424.csv: ") :].splitlines()
    page = (ROOT / "docs" / "replay.md").read_text(encoding="utf-8")
    (shown,) = re.findall(
        r"(?:^    .*\n)+", page[page.index("## Before a replay") : page.index("## Late")], re.MULTILINE
    )
    assert [line[4:] for line in shown.splitlines()][:-1] == lines[:-1]  # the last is the computing time
    assert "windows of 0.8 s with a record every 16 ms: 27, 27 usable" in text
    rows = {line.split()[0]: line.split()[-3:] for line in lines if line.startswith(("  inertia", "  damping"))}
    assert rows == {"inertia": ["0", "of", "8"], "damping": ["4", "of", "8"]}


@needs_data
def test_the_replay_prints_the_figures_of_the_guide(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = printed(folder, "replay rotor-rig.toml healthy_104.csv", monkeypatch)
    for shown in ("1481 rows read", "28 windows: 28 good, 0 bad", "the twin explains 28 of 28 up to the noise"):
        assert shown in GUIDE
        assert shown in text
    (value, half_width) = re.findall(r"^\| `damping ([\d.]+) ± ([\d.]+)`", GUIDE, re.MULTILINE)[0]
    (row,) = [line.split("│") for line in text.splitlines() if line.startswith("│ damping")]
    assert float(row[2]) == pytest.approx(float(value), abs=1e-4)
    assert float(row[3]) == pytest.approx(float(half_width), rel=0.1)
    assert re.search(r"│ inertia +│ +unknown", text)


@needs_data
@pytest.mark.parametrize("log", ROTOR_LOGS)
def test_every_window_of_the_rotor_is_good(folder: Path, log: str) -> None:
    documents = reports(folder, "rotor-rig.toml", log)
    times = table(folder / f"{log}.csv")["t"]
    moving = times[np.flatnonzero(np.diff(times) > 2.0)[-1] + 1 :] if np.diff(times).max() > 2.0 else times
    assert len(documents) == int((moving[-1] - moving[0]) / ROTOR_WINDOW)
    assert [document.window.quality.reasons for document in documents if document.window.quality.reasons] == []
    assert all(document.fit is not None for document in documents)


@needs_data
@pytest.mark.parametrize("log", ["healthy_100", "healthy_104"])
def test_a_healthy_rotor_is_learned_from(folder: Path, log: str) -> None:
    documents = reports(folder, "rotor-rig.toml", log)
    assert refused(documents) == []
    assert not any(document.findings or document.events for document in documents)
    columns = table(folder / f"{log}.csv")
    expected = columns["control_effort"][2:].mean() / columns["speed"][2:].mean()
    assert documents[-1].parameters["damping"].value == pytest.approx(expected, rel=DAMPING)


@needs_data
@pytest.mark.parametrize("log", ["damping_420", "damping_424"])
def test_each_window_alone_shows_the_damper(folder: Path, log: str) -> None:
    columns = table(folder / f"{log}.csv")
    checked = 0
    for document in reports(folder, "rotor-rig.toml", log):
        inside = _inside(columns, document)
        labels = set(columns["damper_ohm"][inside])
        if len(labels) > 1:
            continue
        stretch = columns["damper_ohm"] == labels.pop()
        expected = columns["control_effort"][stretch].mean() / columns["speed"][stretch].mean()
        assert document.parameters["damping"].raw == pytest.approx(expected, rel=DAMPING)
        checked += 1
    assert checked >= 6


@needs_data
def test_the_guide_shows_the_damping_of_each_stretch(folder: Path) -> None:
    (log,) = re.findall(r"<!-- stretches: (\S+) -->", GUIDE)
    columns = table(logs(log))
    rows = re.findall(r"^\| (\d+) ohm \| ([\d.]+) \| ([\d.]+) \|$", GUIDE, re.MULTILINE)
    documents = reports(folder, "rotor-rig.toml", Path(log).stem)
    assert len(rows) == 3
    for label, alone, mean in rows:
        stretch = columns["damper_ohm"] == float(label)
        expected = columns["control_effort"][stretch].mean() / columns["speed"][stretch].mean()
        assert float(mean) == pytest.approx(expected, abs=5e-5)
        raw = [
            document.parameters["damping"].raw
            for document in documents
            if set(columns["damper_ohm"][_inside(columns, document)]) == {float(label)}
        ]
        assert raw
        assert np.median(np.array(raw, dtype=np.float64)) == pytest.approx(float(alone), abs=1e-3)


@needs_data
def test_a_sensor_that_may_be_wrong_is_named_beside_the_damping(folder: Path) -> None:
    text = (folder / "rotor-rig.toml").read_text(encoding="utf-8")
    text = text.replace("sensors = []", "").replace('length = "0.8 s"', 'length = "2 s"')
    (folder / "rotor-any-sensor.toml").write_text(text, encoding="utf-8")
    documents = reports(folder, "rotor-any-sensor.toml", "damping_424")
    texts = [finding_text(finding) for document in documents for finding in document.findings]
    assert any("damping" in text and "speed reads" in text for text in texts)


@needs_data
@pytest.mark.parametrize(("log", "changes"), [("damping_420", 1), ("damping_424", 2)])
def test_each_change_beyond_a_limit_is_an_event_within_five_seconds(folder: Path, log: str, changes: int) -> None:
    """The other change, from 3 to 5 ohm, passes no limit of the guide."""
    columns, documents = table(folder / f"{log}.csv"), reports(folder, "rotor-rig.toml", log)
    times = columns["t"][1:][np.diff(columns["damper_ohm"]) != 0.0]
    for time in times[:changes]:
        ends = [document.window.end for document in documents for event in document.events if event.change is not None]
        assert any(time < end <= time + EVENT_WITHIN for end in ends), (time, ends)
    for document in documents:
        assert document.components == ()
        assert not any("sensor" in finding_text(finding) for finding in document.findings)
        assert all(event.part != SENSORS for event in document.events)
        inside = _inside(columns, document)
        recent = (columns["t"] > document.window.end - SETTLED * ROTOR_WINDOW) & (columns["t"] < document.window.end)
        if len(set(columns["damper_ohm"][recent])) == 1:
            stretch = columns["damper_ohm"] == columns["damper_ohm"][inside][-1]
            expected = columns["control_effort"][stretch].mean() / columns["speed"][stretch].mean()
            assert document.parameters["damping"].value == pytest.approx(expected, rel=DAMPING)


def _inside(columns: dict[str, Array], document: ReportDocument) -> NDArray[np.bool_]:
    """Which rows are in the window of a report."""
    return (columns["t"] >= document.window.start) & (columns["t"] < document.window.end)


@pytest.mark.full
@needs_data
def test_windows_of_the_servo_with_motion_are_used(folder: Path) -> None:
    moving, problems = 0, []
    for log in SERVO_LOGS:
        columns = table(folder / f"{log}.csv")
        documents = reports(folder, f"servo-{log[-5:]}.toml", log)
        assert len(documents) == 3
        assert not any(document.components for document in documents)
        for document in documents:
            inside = _inside(columns, document)
            if np.ptp(columns["position"][inside]) > AT_REST:
                moving += 1
                problems += [f"{log}, {text}" for text in refused([document])]
    assert moving >= 18
    assert len(problems) <= (1.0 - USED) * moving, "\n".join(problems)


@needs_data
def test_the_free_arm_shows_inertia_and_dry_friction(folder: Path) -> None:
    ((inertia, friction),) = re.findall(r"`T_c` are ([\d.]+) kg·m² and ([\d.]+) N·m", GUIDE)
    drop = reports(folder, "servo-kp400.toml", "lift_and_drop_kp400")[1].parameters
    assert drop["J_r"].raw == pytest.approx(float(inertia), rel=2.0 * FIGURE)
    assert drop["T_c"].raw == pytest.approx(float(friction), rel=2.0 * FIGURE)
    assert {item.value for item in drop.values()} == {None}


@needs_data
def test_the_gain_of_the_guide_is_that_of_the_manual(folder: Path) -> None:
    for gain in (100, 400):
        known = dict(load_machine(folder / f"servo-kp{gain}.toml", with_driver=False).problem.known)
        assert known["gain"] == pytest.approx(gain * 4096 / (2 * np.pi) / (256 * 885), rel=1e-3)


def test_a_duty_and_a_speed_show_three_parameters(folder: Path) -> None:
    identifiable = {row.name: row for row in structural_identifiability(load_twin(folder / "bench-motor.toml"))}
    assert {name for name, row in identifiable.items() if not row.identifiable} == {"R"}
    last = reports(folder, "bench.toml", "bench")[-1]
    for name, truth in BENCH.items():
        known = last.parameters[name]
        assert known.low is not None
        assert known.high is not None
        assert known.low <= truth <= known.high
        assert known.high - known.low < 0.03 * truth
    assert not last.components


def test_a_resistance_that_is_too_large_makes_the_others_too_small(folder: Path) -> None:
    wrong = (folder / "bench.toml").read_text(encoding="utf-8") + '\n[parameters]\nR = "5.5 ohm"\n'
    (folder / "bench-wrong.toml").write_text(wrong, encoding="utf-8")
    last = reports(folder, "bench-wrong.toml", "bench")[-1]
    expected = {"K": BENCH["K"], "J": BENCH["J"] / 1.1, "T_c": BENCH["T_c"] / 1.1}
    for name, value in expected.items():
        assert last.parameters[name].value == pytest.approx(value, rel=0.02)


def test_the_delay_of_a_speed_from_counts_is_identified(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (folder / "bench.toml").read_text(encoding="utf-8")
    (folder / "bench-late.toml").write_text(text.replace(', delay = "10 ms"', ""), encoding="utf-8")
    printed_text = printed(folder, "noise bench-late.toml bench.csv", monkeypatch)
    (delay,) = re.findall(r'speed = \{ delay = "([\d.]+) ms" \}', printed_text)
    assert float(delay) == pytest.approx(10.0, abs=1.0)


@pytest.mark.full
def test_more_friction_is_followed_and_no_sensor_is_blamed(folder: Path) -> None:
    documents = reports(folder, "bench.toml", "worn")
    change = next(at for at, document in enumerate(documents) if document.window.end > 20.01)
    for document in documents[change + SETTLED :]:
        friction = document.parameters["T_c"]
        assert friction.low is not None
        assert friction.high is not None
        assert friction.low <= 0.0125 <= friction.high
    assert not [finding for document in documents for finding in document.findings if finding.subject == SENSORS]
