"""Logs of several sources as one recording: a motor whose drive is on CAN and whose speed comes over Modbus TCP."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Array, Verdict
from otolith.cli.replay import replay
from otolith.health.schema import ReportDocument, Status
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.conftest import EXAMPLES
from tests.drivers.logs import BEGUN, frames_of
from tests.drivers.logs import written as written_log

COUNT = 4000  # samples: 20 windows
DELAY, JITTER = 0.020, 0.005  # s
MAX_DEVIATION = 3.5  # standard deviations
MAX_RATIO = 2.0  # of the intervals with two buses over those with one


def motor() -> MotorScenario:
    """The motor of the example for two buses, without faults."""
    scenario = load_scenario(EXAMPLES / "scenarios" / "two-buses.toml")
    assert isinstance(scenario, MotorScenario)
    return scenario.model_copy(update={"faults": ()})


def machine(folder: Path, delay: str = "20 ms") -> Path:
    path = folder / "machine.toml"
    text = (EXAMPLES / "dc-motor-two-buses.toml").read_text(encoding="utf-8")
    text = text.replace('dbc = "dc-motor.dbc"', f'dbc = "{EXAMPLES / "dc-motor.dbc"}"')
    path.write_text(text.replace('delay = "25 ms"', f'delay = "{delay}"'), encoding="utf-8")
    return path


def speeds(folder: Path, scenario: MotorScenario, lateness: Array, begun: float = BEGUN) -> Path:
    """A table of the speed; each sample is late."""
    path = folder / "encoder.csv"
    samples = list(islice(simulate(scenario), len(lateness)))
    times = np.sort(np.array([sample.time for sample in samples]) + lateness)
    rows = [
        f"{begun + time:.6f},{sample.measured['RotorSpeed']!r}" for time, sample in zip(times, samples, strict=True)
    ]
    path.write_text("\n".join(["t,omega", *rows]) + "\n", encoding="utf-8")
    return path


def reports(path: Path, data: str, capsys: pytest.CaptureFixture[str]) -> list[ReportDocument]:
    capsys.readouterr()
    replay(path, [Path(data)], None, as_json=True, stopped=lambda: False)
    return [ReportDocument.from_json(line) for line in capsys.readouterr().out.splitlines()]


def test_a_late_speed_with_jitter_costs_little(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each parameter is within its interval, which is at most twice that of the motor on one bus."""
    scenario, random = motor(), np.random.default_rng(17)
    bus = written_log(tmp_path, frames_of(scenario, COUNT), ".log")
    late = DELAY + JITTER * random.standard_normal(COUNT)
    # The frames of the log are 0.2 ms later than their samples.
    two = reports(machine(tmp_path), f"drive={bus},encoder={speeds(tmp_path, scenario, late)}", capsys)
    punctual = speeds(tmp_path, scenario, np.full(COUNT, 2e-4))
    one = reports(machine(tmp_path, "0 s"), f"drive={bus},encoder={punctual}", capsys)
    assert min(len(two), len(one)) >= COUNT // 200 - 1
    truth = next(simulate(scenario)).truth
    for name, parameter in two[-1].parameters.items():
        reference = one[-1].parameters[name]
        assert parameter.value is not None
        assert parameter.sd is not None
        assert reference.sd is not None
        assert abs(parameter.value - truth[name]) <= MAX_DEVIATION * parameter.sd, name
        assert parameter.sd <= MAX_RATIO * reference.sd, name
    assert not any(report.components for report in two)
    assert two[-1].parameters["R_a"].status is Status.ESTIMATED


def test_a_recording_of_several_sources_gives_the_same_estimates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recording has what the times of each signal mean."""
    scenario, path, recording = motor(), machine(tmp_path), tmp_path / "run.rrd"
    bus = written_log(tmp_path, frames_of(scenario, 1000), ".log")
    table = speeds(tmp_path, scenario, np.full(1000, DELAY))
    data = Path(f"drive={bus},encoder={table}")
    replay(path, [data], recording, as_json=True, stopped=lambda: False)
    live = [ReportDocument.from_json(line) for line in capsys.readouterr().out.splitlines()]
    again = reports(path, str(recording), capsys)
    assert 0 <= len(live) - len(again) <= 1  # the end of the recording may be too short for its last window
    for name, parameter in live[len(again) - 1].parameters.items():
        assert parameter.sd is not None
        assert again[-1].parameters[name].value == pytest.approx(parameter.value, abs=0.2 * parameter.sd)
        assert again[-1].parameters[name].sd == pytest.approx(parameter.sd, rel=0.05)


@pytest.mark.parametrize("gone", ["drive", "encoder"])
def test_one_source_gone_degrades_only_what_needs_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], gone: str
) -> None:
    """Without the drive nothing is estimated; without the encoder the current still gives the resistance."""
    scenario, hole, count = motor(), (BEGUN + 10.0, BEGUN + 18.0), 2400
    frames, table = frames_of(scenario, count), speeds(tmp_path, scenario, np.full(count, DELAY))
    if gone == "drive":
        frames = [frame for frame in frames if not hole[0] <= frame.timestamp < hole[1]]
    else:
        heading, *rows = table.read_text(encoding="utf-8").splitlines()
        rows = [row for row in rows if not hole[0] <= float(row.split(",")[0]) < hole[1]]
        table.write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
    windows = reports(machine(tmp_path), f"drive={written_log(tmp_path, frames, '.log')},encoder={table}", capsys)
    truth = next(simulate(scenario)).truth
    for name in windows[-1].parameters:
        for report in windows:
            parameter = report.parameters[name]
            assert parameter.value is not None
            assert parameter.sd is not None
            assert abs(parameter.value - truth[name]) <= MAX_DEVIATION * parameter.sd, name
    before, inside = windows[4], windows[6:8]
    for report in inside:
        assert report.window.quality.verdict is (Verdict.BAD if gone == "drive" else Verdict.GOOD)
        assert report.parameters["R_a"].status is (Status.HELD if gone == "drive" else Status.ESTIMATED)
        assert (report.parameters["D"].sd or 0.0) > (before.parameters["D"].sd or np.inf)
    assert (windows[-1].parameters["D"].sd or np.inf) < (inside[-1].parameters["D"].sd or 0.0)
    assert windows[-1].parameters["R_a"].status is Status.ESTIMATED


def test_both_logs_have_the_same_result_in_any_order(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = motor()
    bus = written_log(tmp_path, frames_of(scenario, 800), ".log")
    table = speeds(tmp_path, scenario, np.full(800, DELAY))
    path = machine(tmp_path)
    first = reports(path, f"drive={bus},encoder={table}", capsys)
    assert first == reports(path, f"encoder={table},drive={bus}", capsys)
    assert len(first) == 4
    assert first[-1].counters is not None
    assert first[-1].counters.bad == 0


@pytest.mark.parametrize(
    ("data", "begun", "message"),
    [
        ("drive={bus}", BEGUN, "no file of source 'encoder': append ,encoder=FILE"),
        ("{bus}", BEGUN, "a log of one bus, but .* has 2 sources: drive=FILE,encoder=FILE"),
        ("drive={bus},encoder={bus}", BEGUN, "a log of a CAN bus, but source 'encoder' has type = 'modbus'"),
        ("drive={bus},encoder={table}", 0.0, "both must have the times of one clock"),
        ("drive={bus},encoder={table}.gone", BEGUN, "cannot be read"),
        ("drive={bus},encoder=", BEGUN, "is a directory"),
    ],
)
def test_files_that_do_not_fit_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], data: str, begun: float, message: str
) -> None:
    scenario = motor()
    bus = written_log(tmp_path, frames_of(scenario, 400), ".log")
    table = speeds(tmp_path, scenario, np.full(400, DELAY), begun)
    with pytest.raises(ConfigurationError, match=message):
        reports(machine(tmp_path), data.format(bus=bus, table=table), capsys)
