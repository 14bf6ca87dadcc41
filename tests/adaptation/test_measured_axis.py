"""A measured machine: the servo axis of EMPS, with what its authors found in it.

(A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System Identification
Benchmarks, 2019.) The data is not ours: it is looked for where OTOLITH_DATA says, then in ../shared/data.
"""

import os
import re
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.commissioning.consistency import consistency_test
from otolith.commissioning.identification import DOUBTFUL, IdentifiedNoise, identify_noise
from otolith.commissioning.likelihood import Likelihood
from otolith.estimation.information import Identifiability
from otolith.estimation.problem import Problem
from otolith.health.schema import ParameterDocument, ReportDocument, Status
from otolith.machine import find_twin

ROOT = Path(__file__).parents[2]
PLACES = [*map(Path, filter(None, [os.environ.get("OTOLITH_DATA")])), ROOT.parent / "shared" / "data"]
FILE = next((path for place in PLACES if (path := place / "emps" / "data_emps.csv").is_file()), None)
pytestmark = pytest.mark.skipif(
    FILE is None, reason="EMPS is not ours to carry: put emps/data_emps.csv in OTOLITH_DATA"
)

FORCE = 35.1507  # N/V
PERIOD, RECORDS = 1e-3, 2000
MASS = 95.1089  # kg
DIRECTIONAL = {"F_v_up": 166.71, "F_c_up": 20.144, "F_v_down": 240.42, "F_c_down": 20.628}  # N*s/m and N
TURN = 5e-4  # m/s: the authors' sign(v), as sharp as the record likes it (its likelihood grows down to here)
WHOLE = 12  # windows of the record
COUNTS = pytest.mark.parametrize("count", [4, pytest.param(WHOLE, marks=pytest.mark.full)])
"""How many windows are adapted to: nearly each one is searched for components that the twin lacks, which takes long."""
ONE_WAY = 1e-3  # of the path: what a window may go back and still be called so


@lru_cache
def windows() -> tuple[Window, ...]:
    assert FILE is not None
    table = np.loadtxt(FILE, delimiter=",", skiprows=1)
    values = np.column_stack([FORCE * table[:, 3], table[:, 2]])
    pieces = [values[start : start + RECORDS] for start in range(0, len(values) - RECORDS + 1, RECORDS)]
    return tuple(Window.whole(k, 2.0 * k, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces))


def problem(twin: str) -> Problem:
    definition = find_twin(twin)
    free = tuple(entry for entry in definition.parameters if entry.name != "v_s")
    return Problem(definition, (("v_s", TURN),), free, noise=(definition.outputs[0].noise,))


@lru_cache
def learned(twin: str) -> IdentifiedNoise:
    """From every other window; the rest have no part in it."""
    return identify_noise(problem(twin), windows()[::2])


@lru_cache
def reports(twin: str, count: int) -> tuple[ReportDocument, ...]:
    state, found = initial_state("axis", "lab", learned(twin).applied(problem(twin))), []
    for window in windows()[:count]:
        state, report = adapt(state, window)
        found.append(report.document)
    return tuple(found)


def shares(window: Window) -> Array:
    """Of the path, forwards and backwards."""
    steps = np.diff(window.column("x"))
    paths = np.array([np.maximum(steps, 0.0).sum(), np.maximum(-steps, 0.0).sum()])
    return np.asarray(paths / paths.sum())


def test_levels_of_noise_are_those_of_the_encoder_and_of_a_slow_error() -> None:
    found = learned("servo_axis_directional")
    assert found.outputs[0].value < 5e-8  # m: the encoder's step
    assert 2e-3 < found.states[1].value < 1e-2  # m/s/s^0.5
    assert found.consistency.before is not None
    assert found.consistency.before > 10.0  # what white noise alone would have claimed


def test_the_record_has_so_many_windows() -> None:
    assert len(windows()) == WHOLE


@COUNTS
def test_the_mass_is_found_as_soon_as_the_axis_has_moved_both_ways(count: int) -> None:
    both = next(index for index, window in enumerate(windows()) if shares(window).min() > ONE_WAY)
    values = [report.parameters["M"].value for report in reports("servo_axis", count)[both:]]
    assert len(values) >= count - 2
    assert values == pytest.approx([MASS] * len(values), rel=0.015)


@COUNTS
def test_friction_that_differs_by_direction_is_what_the_authors_found(count: int) -> None:
    last = reports("servo_axis_directional", count)[-1].parameters
    found = {name: last[name].value for name in DIRECTIONAL}
    assert found == pytest.approx(DIRECTIONAL, rel=0.05)
    assert last["M"].value == pytest.approx(95.154, rel=0.015)


@COUNTS
def test_no_published_value_jumps_while_the_twin_lacks_the_direction(count: int) -> None:
    """Held or invalid values do not count; what is called estimated stays within its own and the last interval."""
    published = 0
    for name in ("M", "F_v", "F_c", "offset"):
        history = [report.parameters[name] for report in reports("servo_axis", count)]
        for before, now in pairwise(history):
            if now.status is Status.ESTIMATED and now.value is not None and before.value is not None:
                published += 1
                assert abs(now.value - before.value) <= reach(now) + reach(before), (name, now, before)
            assert now.status is Status.ESTIMATED or now.reason
    assert published > {4: 2, WHOLE: 20}[count]


def test_a_twin_that_lacks_the_direction_is_doubted_when_its_noise_is_learned() -> None:
    assert DOUBTFUL in learned("servo_axis").consistency.remark
    assert DOUBTFUL not in learned("servo_axis_directional").consistency.remark


def reach(entry: ParameterDocument) -> float:
    """Half of the 95 % interval."""
    assert entry.low is not None
    assert entry.high is not None
    return 0.5 * (entry.high - entry.low)


def test_windows_that_were_not_learned_from_agree_as_much_as_they_claim() -> None:
    twin = problem("servo_axis_directional")
    told = learned("servo_axis_directional").applied(twin)
    likelihood, levels = Likelihood(twin), np.array([*told.noise, *told.process_noise])
    fits = [likelihood.fit(levels, window, [twin.nominal]) for window in windows()]
    for some in (fits, fits[1::2]):
        found = consistency_test(some, likelihood.width)
        assert found.degrees > 15
        assert 0.5 <= found.reduced <= 2.0


@COUNTS
def test_the_reports_own_estimates_of_single_windows_agree(count: int) -> None:
    """``raw`` and ``raw_sd``, parameter by parameter."""
    squares, degrees = 0.0, 0
    for name in ("M", *DIRECTIONAL):
        entries = [report.parameters[name] for report in reports("servo_axis_directional", count)]
        told = [(entry.raw, entry.raw_sd) for entry in entries if entry.raw is not None and entry.raw_sd is not None]
        values, sd = np.array(told, dtype=np.float64).T
        mean = np.average(values, weights=sd**-2.0)
        squares += float((((values - mean) / sd) ** 2).sum())
        degrees += len(values) - 1
    assert degrees > {4: 6, WHOLE: 30}[count]
    assert 0.5 <= squares / degrees <= 2.0


@COUNTS
def test_one_way_only_friction_and_offset_are_named_as_traded(count: int) -> None:
    seen = 0
    for window, report in zip(windows()[:count], reports("servo_axis", count), strict=True):
        if shares(window).min() > ONE_WAY:
            continue
        seen += 1
        for name, other in (("F_c", "offset"), ("offset", "F_c")):
            entry = report.parameters[name]
            assert entry.identifiability is Identifiability.TRADED
            assert f"traded with {other}" in entry.reason
    assert seen == {4: 2, WHOLE: 5}[count]


@COUNTS
def test_dry_friction_that_the_twin_lacks_is_discovered(count: int) -> None:
    """Viscous friction is in the twin, by direction; the dry one, 20.4 N on the average of both, is not."""
    full = find_twin("servo_axis_directional")
    bare = replace(
        full,
        name="axis_without_dry_friction",
        definitions=tuple(
            (name, re.sub(r" \+ F_c_(up|down)\*tanh\(v/v_s\)", "", text), meaning)
            for name, text, meaning in full.definitions
        ),
        parameters=tuple(entry for entry in full.parameters if entry.name.startswith(("M", "F_v"))),
    )
    told = learned("servo_axis_directional")
    levels = {entry.name: entry.value for entry in told.states}
    process = tuple(levels[entry.name] for entry in bare.states)
    state = initial_state(
        "axis", "lab", Problem(bare, (), bare.parameters, (told.outputs[0].value,), process_noise=process)
    )
    documents = []
    for window in windows()[:count]:
        state, report = adapt(state, window)
        documents.append(report.document)
    (found,) = documents[-1].components
    assert (found.input, found.site) == ("v", "carriage")
    assert found.family == "Coulomb" or count < WHOLE  # after four windows a flat power law explains as much
    assert found.values["amplitude"].value == pytest.approx(-20.4, rel=0.1)
    assert documents[-1].parameters["M"].value == pytest.approx(MASS, rel=0.01)
