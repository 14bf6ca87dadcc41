"""A parameter that moves along a ramp: it is followed, and the ramp is no component."""

from collections.abc import Callable

import numpy as np
import pytest
from benchmarks.changes.machines import PUMP, TWO_MASS
from benchmarks.changes.observe import Case, coverage, observe
from benchmarks.changes.plants import HEALTHY, Change

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Drift
from tests.variants import often

Cut = Callable[..., list[tuple[Window, float]]]
MOTOR = find_twin("dc_motor")
NOMINAL = {row.name: row.nominal for row in MOTOR.parameters}
UNITS = {row.name: row.unit for row in MOTOR.parameters}
WINDOWS, WINDOW = 18, 2.0  # windows, s
HELD_FROM = 7  # window: the third one of the ramp
FOLLOWED_FROM = 13  # window
SDS = 5.0  # of an estimate, in which the truth lies: one window in a million is outside by chance
SLOW = 1e-3  # 1/s: an exponential that is straight over the record


@pytest.mark.parametrize("others", often([()], [(), ("R_a", "L_a", "J", "D")]), ids=["alone", "four"])
@pytest.mark.parametrize(
    ("name", "share_per_second"),
    [
        *(("R_a", -0.002), ("R_a", 0.01), ("D", -0.01)),
        *(pytest.param(*ramp, marks=pytest.mark.full) for ramp in (("R_a", -0.0005), ("R_a", 0.003), ("R_a", -0.01))),
        pytest.param("D", 0.01, marks=pytest.mark.full),
    ],
)
def test_a_parameter_on_a_ramp_is_followed(
    scenario: MotorScenario, windows: Cut, name: str, share_per_second: float, others: tuple[str, ...]
) -> None:
    """At constant speed a torque constant that moves more slowly explains a ramp of D as well: both are held."""
    free, amount = {name, *others}, NOMINAL[name] * share_per_second / SLOW
    ramp = Drift(kind="drift", parameter=name, start="10 s", amount=f"{amount} {UNITS[name]}", rate=f"{SLOW} 1/s")
    known = tuple((row.name, row.nominal) for row in MOTOR.parameters if row.name not in free)
    estimated = tuple(row for row in MOTOR.parameters if row.name in free)
    problem = Problem(MOTOR, known, estimated, (0.005, 0.02), input_noise=(0.0, 0.0002))
    state = initial_state("motor", "bench", problem)
    for window, _ in windows(scenario.model_copy(update={"faults": (ramp,)}), WINDOWS):
        state, report = adapt(state, window)
        truth = NOMINAL[name] + float(ramp.change(np.array([(window.index + 1) * WINDOW]), amount)[0])
        value = report.document.parameters[name]
        assert report.document.components == ()
        if window.index >= HELD_FROM:
            assert value.value is not None
            assert value.sd is not None
            assert abs(value.value - truth) < SDS * value.sd, window.index
            is_followed = name == "R_a" and window.index >= FOLLOWED_FROM
            assert not is_followed or value.value == pytest.approx(truth, rel=0.01)


def test_a_drift_from_before_the_first_window_is_covered_and_no_step() -> None:
    """As of a bearing that warms up when the daemon starts."""
    case = Case("drift", TWO_MASS, HEALTHY, before=Change(ramps={"D_l": 1e-3}), healthy=12, changed=0)
    reports = [window for run in observe(case, range(3), 1) for window in run]
    assert all(window.decision in (WindowDecision.LEARNED, WindowDecision.SUSPECTED) for window in reports)
    assert coverage([window.parameters["D_l"] for window in reports]).reaches(0.9)


@pytest.mark.full
def test_estimates_without_trends_of_a_parameter_on_a_fast_ramp_are_no_step() -> None:
    at = 7
    ramp = Change(ramps={"D_l": -0.03}, since=at * TWO_MASS.records * TWO_MASS.period)
    case = Case("ramp", TWO_MASS, ramp, healthy=at, changed=9)
    late = [report for reports in observe(case, range(4), 3) for report in reports[at + 3 :]]
    assert all(report.components == () for report in late)
    assert all(report.decision is not WindowDecision.SENSOR for report in late)
    assert coverage([report.parameters["D_l"] for report in late]).reaches(0.9)


@pytest.mark.full
def test_a_parameter_that_moved_along_a_ramp_and_stopped_is_no_component() -> None:
    """What follows the ramp contradicts its end; that the parameter has moved is still a hypothesis."""
    window = PUMP.records * PUMP.period
    ramp = Change(ramps={"T_c": -0.03}, since=6 * window)
    stopped = Change(parameters={"T_c": (1.0 - 0.03 * 2 * window) * PUMP.parameters["T_c"]})
    case = Case("stops", PUMP, ramp, healthy=6, changed=9, later=((8, stopped),))
    runs = observe(case, range(4), 1)
    assert all(report.components == () for reports in runs for report in reports)
    assert all(report.decision is not WindowDecision.SENSOR for reports in runs for report in reports)
    late = [report.parameters["T_c"] for reports in runs for report in reports[8:]]
    assert coverage(late).reaches(0.9)
    for own in late:
        assert own.value is not None
        assert own.low is not None
        assert abs(own.value - own.truth) < SDS / QUANTILE * (own.value - own.low)
