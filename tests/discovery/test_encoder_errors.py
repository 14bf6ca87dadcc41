"""A sine of the position is the error of an encoder, or a force: they are told apart, or are one class."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.hypotheses import FaultType
from otolith.health.schema import ReportDocument
from tests.adaptation.test_pooled_windows import STATED, run
from tests.cogging_axis import NOISE, PERIOD, PITCH, QUANTUM, RECORDS, TRUTH, UNEVENNESS, record
from tests.variants import often_rows

SPEED = 0.1  # m/s
KNOWN = tuple((name, value) for name, value in TRUTH.items() if name != "offset")
STEADY = replace(STATED, known=KNOWN, free=tuple(row for row in STATED.free if row.name == "offset"))
FORCE, ERROR = 20.0, 1.3e-5  # N and m: of about the same effect at constant speed


def steady(count: int, force: float, error: float, seed: int) -> list[Window]:
    """Windows of an axis that a constant force moves, with sines of the position: a force, an error of the encoder."""
    random, x, v, rows, dt = np.random.default_rng(seed), 0.0, SPEED, [], PERIOD / 4
    driving = TRUTH["F_v"] * SPEED + TRUTH["F_c"] + TRUTH["offset"]
    for _ in range(count * RECORDS):
        read = x + error * np.sin(2.0 * np.pi * x / PITCH) + NOISE * random.standard_normal()
        rows.append((driving, QUANTUM * np.rint(read / QUANTUM)))
        for _ in range(4):
            v += dt * (TRUTH["F_v"] * (SPEED - v) + force * np.sin(2.0 * np.pi * x / PITCH + 0.7)) / TRUTH["M"]
            x += dt * v
        v += UNEVENNESS * np.sqrt(PERIOD) * random.standard_normal()
    pieces = np.split(np.array(rows), count)
    return [Window.whole(k, k * RECORDS * PERIOD, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces)]


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(2, 7))])
def test_a_moving_axis_shows_that_its_encoder_is_wrong(seed: int) -> None:
    _, documents = run(STATED, record(8, 0.0, seed, encoder_error=6e-6))
    assert not any(document.components for document in documents)
    assert documents[-1].decision is WindowDecision.SENSOR
    (finding,) = (item for item in documents[-1].findings if item.subject == "x")
    size, _, inner = finding.text.removeprefix("x reads wrong by ").partition("·sin(")
    assert float(size) == pytest.approx(6e-6, rel=0.2)
    assert 2.0 * np.pi / float(inner.partition("·")[0]) == pytest.approx(PITCH, rel=5e-3)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(2, 7))])
def test_a_moving_axis_shows_that_a_force_is_none_of_its_encoder(seed: int) -> None:
    _, documents = run(STATED, record(8, 12.0, seed))
    (component,) = documents[-1].components
    assert component.id == "carriage/periodic/x"
    assert component.values["amplitude"].value == pytest.approx(12.0, rel=0.15)
    assert all(document.decision is not WindowDecision.SENSOR for document in documents)


@pytest.mark.parametrize("seed", [5, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2, 3, 4))])
@pytest.mark.parametrize(("force", "error"), [(FORCE, 0.0), (0.0, ERROR)], ids=("force", "encoder"))
def test_at_constant_speed_force_and_encoder_are_one_class(seed: int, force: float, error: float) -> None:
    """Until small changes of the speed have shown in many windows which of the two it is."""
    _, documents = run(STEADY, steady(9, force, error, seed))
    decisions = [document.decision for document in documents]
    assert WindowDecision.SENSOR not in decisions or not force
    assert not any(document.components for document in documents) or not error
    assert WindowDecision.AMBIGUOUS in decisions
    assert any(map(states_both, documents))


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2, 4, 5, 6, 7))])
@pytest.mark.parametrize(
    ("force", "error"),
    often_rows([(0.0, ERROR)], [(FORCE, 0.0), (0.0, ERROR), (0.0, 6e-6)]),
    ids=("force", "13 um", "6 um"),
)
def test_where_nothing_shows_the_mass_neither_force_nor_encoder_is_a_verdict(
    seed: int, force: float, error: float
) -> None:
    """At constant speed only a known mass distinguishes them: the estimate of one that nothing excites is anything."""
    _, documents = run(STATED, steady(14, force, error, seed))
    assert documents[-1].decision in (WindowDecision.SUSPECTED, WindowDecision.AMBIGUOUS, WindowDecision.LEARNED)
    assert WindowDecision.SENSOR not in [document.decision for document in documents]
    assert not any(document.components for document in documents)


def states_both(document: ReportDocument) -> bool:
    """Whether force and encoder are equally probable."""
    leading = document.explanations[:2]
    is_class = {item.reason for item in leading} == {FaultType.SENSOR, FaultType.COMPONENT}
    return is_class and leading[0].probability == pytest.approx(leading[1].probability)
