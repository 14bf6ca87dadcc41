"""The measured servo axis EMPS, compared with the estimates of its authors.

(A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System Identification
Benchmarks, 2019.) The data is not part of this project: the tests read it from OTOLITH_DATA or ../shared/data.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import ComponentRecord, initial_state, restore_components
from otolith.commissioning.consistency import consistency_test
from otolith.commissioning.identification import DOUBTFUL, IdentifiedNoise, identify_noise
from otolith.commissioning.likelihood import Likelihood
from otolith.commissioning.structure import remaining_structure
from otolith.estimation.information import Identifiability
from otolith.estimation.problem import Problem, augment
from otolith.health.schema import ParameterDocument, ReportDocument, Status
from otolith.machine import find_twin

ROOT = Path(__file__).parents[2]
PLACES = [*map(Path, filter(None, [os.environ.get("OTOLITH_DATA")])), ROOT.parent / "shared" / "data"]
FILE = next((path for place in PLACES if (path := place / "emps" / "data_emps.csv").is_file()), None)
pytestmark = pytest.mark.skipif(
    FILE is None, reason="EMPS is not part of this project: put emps/data_emps.csv into OTOLITH_DATA"
)

FORCE = 35.1507  # N/V
PERIOD, RECORDS = 1e-3, 2000
MASS = 95.1089  # kg
DIRECTIONAL = {"F_v_up": 166.71, "F_c_up": 20.144, "F_v_down": 240.42, "F_c_down": 20.628}  # N*s/m and N
TURN = 5e-4  # m/s: width of the authors' sign(v); the likelihood of the record increases down to this width
ALL_WINDOWS = 12  # windows of the record
COUNTS = pytest.mark.parametrize("count", [4, pytest.param(ALL_WINDOWS, marks=pytest.mark.full)])
"""Number of windows. Nearly every window starts a search for missing components, which takes long."""
ONE_WAY = 1e-3  # of the path: largest share in the other direction of a one-way window


@lru_cache
def windows() -> tuple[Window, ...]:
    assert FILE is not None
    table = np.loadtxt(FILE, delimiter=",", skiprows=1)
    values = np.column_stack([FORCE * table[:, 3], table[:, 2]])
    pieces = [values[start : start + RECORDS] for start in range(0, len(values) - RECORDS + 1, RECORDS)]
    return tuple(Window.whole(k, 2.0 * k, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces))


def problem(twin: str) -> Problem:
    definition = find_twin(twin)
    free = tuple(parameter for parameter in definition.parameters if parameter.name != "v_s")
    return Problem(definition, (("v_s", TURN),), free, noise=(definition.outputs[0].noise,))


@lru_cache
def identified(twin: str) -> IdentifiedNoise:
    """Noise levels identified from every other window."""
    return identify_noise(problem(twin), windows()[::2])


@lru_cache
def reports(twin: str, count: int) -> tuple[ReportDocument, ...]:
    state, documents = initial_state("axis", "lab", identified(twin).applied(problem(twin))), []
    for window in windows()[:count]:
        state, report = adapt(state, window)
        documents.append(report.document)
    return tuple(documents)


def shares(window: Window) -> Array:
    """Shares of the path forwards and backwards (1)."""
    steps = np.diff(window.column("x"))
    paths = np.array([np.maximum(steps, 0.0).sum(), np.maximum(-steps, 0.0).sum()])
    return np.asarray(paths / paths.sum())


@pytest.mark.full
def test_noise_levels_of_encoder_and_slow_model_error() -> None:
    noise = identified("servo_axis_directional")
    assert noise.outputs[0].value < 5e-8  # m: the encoder's step
    assert 2e-3 < noise.states[1].value < 1e-2  # m/s/s^0.5
    assert noise.consistency.before is not None
    assert noise.consistency.before > 10.0  # reduced chi-square with white noise only


def test_the_record_has_twelve_windows() -> None:
    assert len(windows()) == ALL_WINDOWS


@COUNTS
def test_mass_is_right_after_motion_in_both_directions(count: int) -> None:
    both = next(index for index, window in enumerate(windows()) if shares(window).min() > ONE_WAY)
    values = [report.parameters["M"].value for report in reports("servo_axis", count)[both:]]
    assert len(values) >= count - 2
    assert values == pytest.approx([MASS] * len(values), rel=0.015)


@COUNTS
def test_friction_by_direction_agrees_with_the_authors(count: int) -> None:
    last = reports("servo_axis_directional", count)[-1].parameters
    friction = {name: last[name].value for name in DIRECTIONAL}
    assert friction == pytest.approx(DIRECTIONAL, rel=0.05)
    assert last["M"].value == pytest.approx(95.154, rel=0.015)


@COUNTS
def test_no_published_value_jumps_with_symmetric_friction(count: int) -> None:
    """Consecutive estimates differ by less than the sum of their half intervals. Held and invalid ones do not count."""
    published = 0
    for name in ("M", "F_v", "F_c", "offset"):
        history = [report.parameters[name] for report in reports("servo_axis", count)]
        for before, now in pairwise(history):
            if now.status is Status.ESTIMATED and now.value is not None and before.value is not None:
                published += 1
                assert abs(now.value - before.value) <= half_interval(now) + half_interval(before), (name, now, before)
            assert now.status is Status.ESTIMATED or now.reason
    assert published > {4: 2, ALL_WINDOWS: 20}[count]


def test_noise_identification_flags_symmetric_friction() -> None:
    assert DOUBTFUL in identified("servo_axis").consistency.remark
    assert DOUBTFUL not in identified("servo_axis_directional").consistency.remark


def half_interval(parameter: ParameterDocument) -> float:
    """Half the width of the 95 % interval."""
    assert parameter.low is not None
    assert parameter.high is not None
    return 0.5 * (parameter.high - parameter.low)


def test_windows_not_used_for_identification_are_consistent() -> None:
    twin = problem("servo_axis_directional")
    noisy = identified("servo_axis_directional").applied(twin)
    likelihood, levels = Likelihood(twin), np.array([*noisy.noise, *noisy.process_noise])
    fits = [likelihood.fit(levels, window, [twin.nominal]) for window in windows()]
    for some in (fits, fits[1::2]):
        test = consistency_test(some, likelihood.width)
        assert test.degrees > 15
        assert 0.5 <= test.reduced <= 2.0


@COUNTS
def test_reported_estimates_of_single_windows_are_consistent(count: int) -> None:
    """Reduced chi-square of ``raw`` with ``raw_sd``, per parameter and summed."""
    squares, degrees = 0.0, 0
    for name in ("M", *DIRECTIONAL):
        parameters = [report.parameters[name] for report in reports("servo_axis_directional", count)]
        estimates = [
            (parameter.raw, parameter.raw_sd)
            for parameter in parameters
            if parameter.raw is not None and parameter.raw_sd is not None
        ]
        values, sd = np.array(estimates, dtype=np.float64).T
        mean = np.average(values, weights=sd**-2.0)
        squares += float((((values - mean) / sd) ** 2).sum())
        degrees += len(values) - 1
    assert degrees > {4: 6, ALL_WINDOWS: 30}[count]
    assert 0.5 <= squares / degrees <= 2.0


@COUNTS
def test_one_way_windows_trade_friction_with_offset(count: int) -> None:
    one_way = 0
    for window, report in zip(windows()[:count], reports("servo_axis", count), strict=True):
        if shares(window).min() > ONE_WAY:
            continue
        one_way += 1
        for name, other in (("F_c", "offset"), ("offset", "F_c")):
            parameter = report.parameters[name]
            assert parameter.identifiability is Identifiability.TRADED
            assert f"traded with {other}" in parameter.reason
    assert one_way == {4: 2, ALL_WINDOWS: 5}[count]


@COUNTS
def test_missing_dry_friction_is_discovered(count: int) -> None:
    """The twin has viscous friction by direction, but no dry friction, 20.4 N in the mean of both directions."""
    full = find_twin("servo_axis_directional")
    bare = replace(
        full,
        name="axis_without_dry_friction",
        definitions=tuple(
            (name, re.sub(r" \+ F_c_(up|down)\*tanh\(v/v_s\)", "", text), meaning)
            for name, text, meaning in full.definitions
        ),
        parameters=tuple(parameter for parameter in full.parameters if parameter.name.startswith(("M", "F_v"))),
    )
    noise = identified("servo_axis_directional")
    levels = {level.name: level.value for level in noise.states}
    process = tuple(levels[state.name] for state in bare.states)
    state = initial_state(
        "axis", "lab", Problem(bare, (), bare.parameters, (noise.outputs[0].value,), process_noise=process)
    )
    documents = []
    for window in windows()[:count]:
        state, report = adapt(state, window)
        documents.append(report.document)
    (component,) = documents[-1].components
    assert (component.input, component.site) == ("v", "carriage")
    assert component.family == "Coulomb" or count < ALL_WINDOWS  # after four windows a flat power law explains as much
    assert component.values["amplitude"].value == pytest.approx(-20.4, rel=0.1)
    assert documents[-1].parameters["M"].value == pytest.approx(MASS, rel=0.01)


# Pitch (m) and amplitude (N) of a least-squares fit of the force of each half, low-passed at 200 Hz, with friction by
# direction. The half's windows begin at its first record, as those of a file of its own.
HALVES = {0: (2.50127e-3, 1.058), 1: (2.50195e-3, 1.110)}


@lru_cache
def half(number: int) -> tuple[Window, ...]:
    values = np.concatenate([window.values for window in windows()])
    rows = values[number * len(values) // 2 :][: len(values) // 2]
    pieces = rows.reshape(-1, RECORDS, rows.shape[1])
    return tuple(Window.whole(k, 2.0 * k, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces))


@pytest.mark.full
def test_the_whole_record_offers_nothing_but_the_force_that_depends_on_position() -> None:
    """Friction that grows less than linearly shows as a power at the least exponent: its shape is not determined."""
    twin = problem("servo_axis_directional")
    shown = remaining_structure(twin, identify_noise(twin, windows()), windows())
    (offered,) = [item for item in shown if item.is_offered]
    assert offered.component.key == "carriage/periodic/x"
    assert 2.0 * np.pi / offered.component.inner == pytest.approx(2.5017e-3, rel=1e-3)
    assert offered.component.amplitude == pytest.approx(1.07, rel=0.1)


@pytest.mark.full
@pytest.mark.parametrize("number", HALVES)
def test_a_commissioned_axis_follows_the_force_that_depends_on_position_on_either_half(number: int) -> None:
    """Nothing but this force is offered; in the twin it stays, and no other component is adopted."""
    twin = problem("servo_axis_directional")
    noise = identify_noise(twin, half(number))
    (shown,) = remaining_structure(twin, noise, half(number))
    beside = identify_noise(augment(twin, [shown.component]), half(number))
    for other, (pitch, amplitude) in HALVES.items():
        state = restore_components(initial_state("axis", "lab", beside.applied(twin)), (ComponentRecord.of(shown),))
        for window in half(other):
            state, report = adapt(state, window)
            (component,) = report.document.components
            values = {name: value.value for name, value in component.values.items()}
            assert component.id == "carriage/periodic/x"
            assert 2.0 * np.pi / values["order"] == pytest.approx(pitch, rel=1e-3)
            assert values["amplitude"] == pytest.approx(amplitude, rel=0.1)
            assert report.document.parameters["M"].value == pytest.approx(MASS, rel=0.015)


@pytest.mark.full
@pytest.mark.parametrize("number", HALVES)
def test_a_half_adopts_the_force_that_depends_on_position_with_its_commissioned_noise(number: int) -> None:
    """Nobody approved it, and no window shows it alone. Nothing else is adopted."""
    twin = problem("servo_axis_directional")
    assert_adopted_and_followed(identify_noise(twin, half(number)).applied(twin), half(number), *HALVES[number])


@pytest.mark.full
def test_the_whole_record_adopts_the_force_that_depends_on_position() -> None:
    pitch, amplitude = np.mean(list(HALVES.values()), axis=0)
    noisy = identified("servo_axis_directional").applied(problem("servo_axis_directional"))
    assert_adopted_and_followed(noisy, windows(), pitch, amplitude)


def assert_adopted_and_followed(noisy: Problem, record: Sequence[Window], pitch: float, amplitude: float) -> None:
    state, documents = initial_state("axis", "lab", noisy), []
    for window in record:
        state, report = adapt(state, window)
        documents.append(report.document)
        assert report.document.parameters["M"].value == pytest.approx(MASS, rel=0.015)
    with_components = [document for document in documents if document.components]
    assert len(with_components) >= len(record) - 4
    for document in with_components:
        (component,) = document.components
        values = {name: value.value for name, value in component.values.items()}
        assert component.id == "carriage/periodic/x"
        assert 2.0 * np.pi / values["order"] == pytest.approx(pitch, rel=1e-3)
        assert values["amplitude"] == pytest.approx(amplitude, rel=0.1)
    assert with_components[-1] is documents[-1]
