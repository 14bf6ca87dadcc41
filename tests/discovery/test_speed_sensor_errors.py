"""A speed that is read wrong once a turn, or an unbalanced shaft: they are told apart, or are one class."""

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.hypotheses import FaultType
from otolith.health.schema import ReportDocument
from tests.adaptation.measured_like import NOISE, PERIOD, RECORDS, SIGNALS, TRUTH, motor_problem, reports
from tests.variants import often

TORQUE, RIPPLE, ECCENTRICITY = 0.02, 0.4, 0.01  # N·m, rad/s, and of the speed: about the same at constant speed
HEALTHY, WINDOWS, VERDICT_WINDOWS = 2, 9, 5
STEADY, LEVELS, HELD, LOAD = 12.0, (8.0, 20.0), (20, 80), 0.01  # V, V, records, N·m
SUBSTEPS = 10
BOTH, ONE = ("i", "omega"), ("omega",)
EQUAL = 0.03  # difference of probabilities; small ones are not stated
UNBALANCE = "shaft/periodic/angle(omega)"
SEEDS = pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(2, 7))])
ERRORS = pytest.mark.parametrize(
    ("ripple", "eccentricity"), [(RIPPLE, 0.0), (0.0, ECCENTRICITY)], ids=("ripple", "eccentric")
)


def turning(
    seed: int, sensors: tuple[str, ...], *, torque: float = 0.0, ripple: float = 0.0, eccentricity: float = 0.0,
    steady: bool = False,
) -> list[ReportDocument]:  # fmt: skip
    """Reports of a motor; after some healthy windows a torque, or an error of its tachometer, repeats each turn.

    The error is a ``ripple`` (rad/s) or grows with the speed by its ``eccentricity``. ``steady`` is its voltage.
    """
    random, step = np.random.default_rng(seed), PERIOD / SUBSTEPS
    r_a, l_a, j, k_e, k_t, d = (TRUTH[name] for name in ("R_a", "L_a", "J", "K_e", "K_t", "D"))
    voltage, left, values = STEADY, 0, np.empty((WINDOWS * RECORDS, len(SIGNALS)))
    speed = (k_t * voltage / r_a - LOAD) / (d + k_t * k_e / r_a)
    state = np.array([(voltage - k_e * speed) / r_a, speed, random.uniform(0.0, 6.0)])
    for record in range(len(values)):
        if not steady and not left:
            left, voltage = int(random.integers(*HELD)), random.uniform(*LEVELS)
        left -= 1
        is_faulty = record >= HEALTHY * RECORDS
        wrong = is_faulty * (ripple + eccentricity * state[1]) * np.sin(state[2] + 0.3)
        values[record] = voltage, LOAD, *(state[:2] + [0.0, wrong] + np.array(NOISE) * random.normal(size=2))

        def rates(x: np.ndarray, u: float = voltage, unbalance: float = is_faulty * torque) -> np.ndarray:
            shaft = k_t * x[0] - LOAD - d * x[1] + unbalance * np.sin(x[2] + 0.7)
            return np.array([(u - r_a * x[0] - k_e * x[1]) / l_a, shaft / j, x[1]])

        for _ in range(SUBSTEPS):
            middle = state + 0.5 * step * rates(state)
            state = state + step * rates(middle)
    columns = [at for at, name in enumerate(SIGNALS) if name not in BOTH or name in sensors]
    names = tuple(SIGNALS[at] for at in columns)
    parts = enumerate(np.split(values[:, columns], WINDOWS))
    windows = [Window.whole(at, at * RECORDS * PERIOD, PERIOD, names, part) for at, part in parts]
    return reports(motor_problem("D", sensors=sensors), windows)


@SEEDS
@ERRORS
@pytest.mark.parametrize("sensors", often([BOTH], [ONE, BOTH]), ids=len)
def test_a_speed_that_changes_shows_an_error_of_its_sensor(
    seed: int, ripple: float, eccentricity: float, sensors: tuple[str, ...]
) -> None:
    documents = turning(seed, sensors, ripple=ripple, eccentricity=eccentricity)
    assert not any(document.components for document in documents)
    assert all(document.decision is WindowDecision.SENSOR for document in documents[HEALTHY + VERDICT_WINDOWS :])
    text = documents[-1].findings[0].text
    size, _, shape = text.removeprefix("omega reads wrong by ").partition("·sin(")
    assert float(size) == pytest.approx(ripple + eccentricity, rel=0.05)
    assert float(shape.partition("·")[0]) == pytest.approx(1.0, rel=0.01)
    assert ("·omega:" in text) is bool(eccentricity)


@SEEDS
@pytest.mark.parametrize("sensors", [ONE, BOTH], ids=len)
def test_a_speed_that_changes_shows_that_the_shaft_is_unbalanced(seed: int, sensors: tuple[str, ...]) -> None:
    documents = turning(seed, sensors, torque=TORQUE)
    first = documents[HEALTHY + VERDICT_WINDOWS - 1]
    assert [component.id for component in first.components] == [UNBALANCE]
    assert first.components[0].values["amplitude"].value == pytest.approx(TORQUE, rel=0.05)
    assert not any(document.decision is WindowDecision.SENSOR for document in documents)


@SEEDS
@pytest.mark.parametrize(
    ("torque", "ripple", "eccentricity"), [(TORQUE, 0.0, 0.0), (0.0, RIPPLE, 0.0), (0.0, 0.0, ECCENTRICITY)]
)
def test_at_constant_speed_without_a_current_unbalance_and_sensor_are_one_class(
    seed: int, torque: float, ripple: float, eccentricity: float
) -> None:
    documents = turning(seed, ONE, torque=torque, ripple=ripple, eccentricity=eccentricity, steady=True)
    assert not any(document.components for document in documents)
    assert not any(document.decision is WindowDecision.SENSOR for document in documents)
    assert any(document.decision is WindowDecision.AMBIGUOUS for document in documents)
    assert any(map(states_both, documents))


@SEEDS
def test_at_constant_speed_the_current_is_not_contradicted(seed: int) -> None:
    """An unbalance modulates it, by back-EMF; here by less than its noise, so that many windows must agree."""
    unbalanced, wrong = turning(seed, BOTH, torque=TORQUE, steady=True), turning(seed, BOTH, ripple=RIPPLE, steady=True)
    assert not any(document.components for document in wrong)
    assert not any(document.decision is WindowDecision.SENSOR for document in unbalanced)


def states_both(document: ReportDocument) -> bool:
    """Whether a torque on the shaft and the sensor of the speed are equally probable."""
    places = ((FaultType.COMPONENT, "shaft: "), (FaultType.SENSOR, "omega reads wrong by "))
    torque, sensor = (
        sum(item.probability for item in document.explanations if item.reason == kind and item.text.startswith(place))
        for kind, place in places
    )
    return torque > 0.1 and sensor == pytest.approx(torque, abs=EQUAL)
