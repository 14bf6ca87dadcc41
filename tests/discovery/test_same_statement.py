"""A component that states no more than that a parameter has changed is that parameter's change, and no alternative."""

from dataclasses import replace

import pytest
from benchmarks.changes.machines import DC_MOTOR, LAB_MOTOR, PUMP, SERVO_AXIS, twin_of
from benchmarks.changes.observe import Case, observe
from benchmarks.changes.plants import Change, Plant, Term

from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.hypotheses import FaultType, TrackedHypothesis
from otolith.discovery.same_statement import parameters_like, without_repetitions
from otolith.estimation.problem import Component, augment
from otolith.machine import find_twin
from otolith.twin.definition import Definition
from otolith.twin.unmeasured import Assumption, UnmeasuredInput, without_sensor
from tests.discovery.test_sequential_test import BARE, COULOMB, PERIODIC, R_A, hypothesis
from tests.variants import often_rows

MOTOR, PUMP_TWIN = find_twin("dc_motor"), find_twin("pump")
HOIST = without_sensor(MOTOR, UnmeasuredInput("T_load", Assumption.CONSTANT))
FASTER = replace(DC_MOTOR, period=4.0 * DC_MOTOR.period, steps=4 * DC_MOTOR.steps)
"""The current changes much from record to record, so that the response to c·i is only about that to R_a."""
RESISTANCE = Component("winding", "linear", "i", 1.3)


@pytest.mark.parametrize(
    ("twin", "site", "family", "source", "parameters"),
    [
        (MOTOR, "winding", "linear", "i", ("R_a",)),
        (MOTOR, "winding", "linear", "omega", ("K_e",)),
        (MOTOR, "shaft", "linear", "omega", ("D",)),
        (MOTOR, "shaft", "linear", "i", ("K_t",)),
        (HOIST, "shaft", "constant", "", ("T_load",)),
        (PUMP_TWIN, "pipe", "constant", "", ("p_static",)),
        (find_twin("servo_axis"), "carriage", "linear", "v", ("F_v",)),
        (find_twin("two_mass"), "load_side", "linear", "omega_l", ("D_l",)),
        (find_twin("fan"), "air", "constant", "", ("k_air",)),
        (find_twin("hydraulic_actuator"), "force", "linear", "x", ("k_spring",)),
    ],
)
def test_a_component_has_the_effect_of_a_parameter(
    twin: Definition, site: str, family: str, source: str, parameters: tuple[str, ...]
) -> None:
    assert parameters_like(twin, site, family, source) == parameters


@pytest.mark.parametrize(
    ("twin", "site", "family", "source"),
    [
        (MOTOR, "shaft", "constant", ""),  # the twin has no dry friction
        (MOTOR, "winding", "constant", ""),
        (MOTOR, "winding", "linear", "V_a"),  # as a sensor of V_a that reads wrong
        (MOTOR, "shaft", "power", "omega"),
        (MOTOR, "sensor of i", "linear", "i"),
        (PUMP_TWIN, "head", "constant", ""),  # h_0 is a part of the head
        (twin_of(LAB_MOTOR), "shaft", "linear", "omega"),  # K enters twice, and friction is dry
    ],
)
def test_a_component_that_no_parameter_has_the_effect_of_is_a_statement_of_its_own(
    twin: Definition, site: str, family: str, source: str
) -> None:
    assert parameters_like(twin, site, family, source) == ()


def _pair(value: float, misfit: float = 0.0) -> tuple[TrackedHypothesis, TrackedHypothesis]:
    """R_a, moved to ``value``, with so much more misfit than the voltage in proportion to the current."""
    moved = hypothesis(FaultType.PARAMETER, BARE, R_a=(value, 0.01))
    moved = replace(moved, misfit=misfit, hypothesis=replace(moved.hypothesis, name="R_a"))
    return moved, hypothesis(FaultType.COMPONENT, augment(BARE, [RESISTANCE]))


def test_the_parameter_takes_what_the_component_states() -> None:
    moved, component = _pair(5.2)
    brushes = hypothesis(FaultType.COMPONENT, augment(BARE, [Component("winding", "constant", "", -0.5)]))
    null = hypothesis(FaultType.NOTHING, BARE)
    assert without_repetitions([component, moved, brushes, null], BARE) == [moved, brushes, null]


@pytest.mark.parametrize(("value", "misfit"), [(0.99 * R_A.low, 0.0), (1.01 * R_A.high, 0.0), (5.2, 11.0)])
def test_a_component_stays_where_the_parameter_is_beyond_its_bounds_or_does_not_explain_it(
    value: float, misfit: float
) -> None:
    moved, component = _pair(value, misfit)
    assert without_repetitions([component, moved], BARE) == [component, moved]


def test_a_component_that_the_twin_has_already_is_no_repetition() -> None:
    moved, component = _pair(5.2)
    assert without_repetitions([moved, component], component.problem) == [moved, component]


@pytest.mark.parametrize(("exponent", "sd", "stays"), [(1.02, 0.02, False), (1.1, 0.02, True)])
def test_a_power_is_a_line_unless_its_exponent_is_another(exponent: float, sd: float, stays: bool) -> None:
    moved, _ = _pair(5.2)
    problem = augment(BARE, [Component("winding", "power", "i", 1.3, 1.0, low=0.3, high=4.0)])
    inner = problem.free[-1].name
    power = hypothesis(FaultType.COMPONENT, problem, **{inner: (exponent, sd)})
    assert without_repetitions([moved, power], BARE) == ([moved, power] if stays else [moved])


def test_what_a_parameter_states_beside_a_component_is_stated_once() -> None:
    one, both, other = ([PERIODIC], [RESISTANCE, PERIODIC], [RESISTANCE, COULOMB])
    wave, repeated, rest = (hypothesis(FaultType.COMPONENT, augment(BARE, own)) for own in (one, both, other))
    assert without_repetitions([repeated, wave, rest], BARE) == [wave, rest]
    assert without_repetitions([repeated, wave.worse_by(11.0, 11.0)], BARE)[0] is repeated


ROWS = [
    (DC_MOTOR, "R_a", 0.7, 0),
    (FASTER, "R_a", 0.7, 1),
    (FASTER, "K_t", 0.7, 0),
    (SERVO_AXIS, "F_v", 0.8, 0),
    (SERVO_AXIS, "F_v", 1.2, 1),
    (PUMP, "p_static", 0.8, 0),
]


@pytest.mark.parametrize(("plant", "name", "factor", "run"), often_rows(ROWS[:1], ROWS))
def test_a_parameter_that_moved_is_named_alone(plant: Plant, name: str, factor: float, run: int) -> None:
    """A class of two statements that are one would stay for ever, and the person would get no answer."""
    change = Change(parameters={name: factor * plant.parameters[name]})
    case = Case("step", plant, change, healthy=5, changed=4)
    estimated = tuple(dict.fromkeys((*(item.name for item in case.problem.free), name)))
    (windows,) = observe(replace(case, free=estimated), [run], 1)
    decisions = [window.decision for window in windows[5:]]
    assert decisions == [WindowDecision.SUSPECTED, WindowDecision.STEPPED, *[WindowDecision.LEARNED] * 2]
    for window in windows[6:]:
        own = window.parameters[name]
        assert own.low is not None
        assert own.high is not None
        assert own.truth == pytest.approx(0.5 * (own.low + own.high), abs=own.high - own.low)  # 3.9 standard deviations


@pytest.mark.parametrize(("name", "factor"), often_rows([("R_a", 0.7)], [("R_a", 0.7), ("K_t", 0.7)]))
def test_a_known_parameter_that_moved_is_named_alone(name: str, factor: float) -> None:
    change = Change(parameters={name: factor * DC_MOTOR.parameters[name]})
    free = tuple(own for own in ("R_a", "D") if own != name)
    (windows,) = observe(Case("step", FASTER, change, free, healthy=5, changed=4), [0], 1)
    assert [window.decision for window in windows[5:]] == [WindowDecision.SUSPECTED] * 4
    best = windows[-1].stated[0]
    assert (best.reason, best.text) == ("PARAMETER", name)
    assert best.probability > 0.99


@pytest.mark.full
@pytest.mark.parametrize("plant", [DC_MOTOR, FASTER], ids=["10 ms", "40 ms"])
def test_a_parameter_that_moved_beside_a_new_component_is_followed(plant: Plant) -> None:
    change = Change({"R_a": 0.7 * plant.parameters["R_a"]}, terms={"shaft": Term("periodic", "t", 0.004, 8.0)})
    (windows,) = observe(Case("both", plant, change, healthy=5, changed=5), [0], 1)
    assert [item.text for item in windows[-1].components] == ["shaft/periodic/t"]
    assert windows[-1].parameters["R_a"].holds_truth
