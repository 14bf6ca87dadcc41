"""Random components for the motor, 3 to 30 times as large as the detection limit.

The detection limit is the amplitude whose gain in -2 log evidence, expected from the linear picture of a healthy
window of the same operation, equals what the search asks for: amplitude² * information = numbers * log(values) +
2 log(3 alternatives) + DECISIVE. The information is the part of the unit response that parameters, trends and initial
state do not explain, given the prior; alternatives are the candidates of the machine in that window,
not those of its sensors.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.discovery.motor import Faults, simulate_motor, windows
from benchmarks.discovery.setting import prior, problem, screen
from benchmarks.discovery.truth import SHAFT, Truth, is_a_parameter
from otolith.acquisition.window import Array, Window
from otolith.discovery.candidate_forms import CandidateForm, PhysicalRange
from otolith.discovery.linear_response import LinearResponse, basis_functions
from otolith.discovery.screening import ScreeningResult, candidate_library
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.information import Prior
from otolith.twin.components import COMPONENT_FAMILIES, ComponentFamily, SourceKind, sites, sources

SECONDS = 2.0
MIN_RATIO, MAX_RATIO = 3.0, 30.0  # of the detection limit
KINDS = ("steps", "constant", "sweep", "reversing")
OPERATIONS_OF_FAMILY = {
    "logarithmic": ("steps", "sweep"),
    "Coulomb": ("reversing",),
    "Stribeck": ("steps", "sweep", "reversing"),
}
INNER_MARGIN = 1.3  # factor between an inner number and the ends of its observable range
NEARLY_LINEAR = (0.75, 1.3)  # exponents whose power is hardly distinguishable from a parameter: not drawn
MAX_EFFECT = {
    True: 0.1,
    False: 10.0,
}  # N·m on the shaft (True), V in the winding (False): a larger effect is no fault but another motor
ATTEMPTS = 200


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A component and a window with it."""

    number: int
    kind: str
    """Of operation."""
    times: float
    """Of the detection limit."""
    truth: Truth
    prior: Prior
    window: Window
    false_gain: float
    """Gain of the screening test in the healthy window of the same operation."""


def draw(number: int, seed: int) -> Case:
    """The case of that number, of one family after another.

    Raises:
        RuntimeError: no component of the family is detectable in any operation.
    """
    random = np.random.default_rng([seed, number])
    model = COMPONENT_FAMILIES[number % len(COMPONENT_FAMILIES)]
    for _ in range(ATTEMPTS):
        case = _draw_once(number, model, random)
        if case is not None:
            return case
    raise RuntimeError(f"no case of family {model.name!r} in {ATTEMPTS} attempts")


def _draw_once(number: int, model: ComponentFamily, random: np.random.Generator) -> Case | None:
    kind, operation = str(random.choice(OPERATIONS_OF_FAMILY.get(model.name, KINDS))), int(random.integers(2**31))
    known = prior(random)
    healthy = recorded(kind, Faults(), operation)
    screening = screen(problem(), healthy, known)
    chosen = _chosen(model, kind, screening.response, random)
    if chosen is None:
        return None
    times = float(np.exp(random.uniform(np.log(MIN_RATIO), np.log(MAX_RATIO))))
    truth = _truth(chosen, times, screening.response, random)
    if truth is None:
        return None
    try:
        window = recorded(kind, truth.faults(), operation)
    except OverflowError:  # the motor is unstable
        return None
    if not _is_distinguishable(truth, chosen, window, known):
        return None
    return Case(number, kind, times, truth, known, window, screening.gain)


def recorded(kind: str, faults: Faults, operation: int) -> Window:
    """One window; ``operation`` seeds set-points and noise."""
    return windows(simulate_motor(kind, SECONDS, faults, operation))[0]


def _chosen(
    model: ComponentFamily, kind: str, landscape: LinearResponse, random: np.random.Generator
) -> CandidateForm | None:
    """A candidate of the family that this operation excites and that is no parameter; all sites are equally likely."""
    twin = problem().base_model
    candidates: dict[int, list[CandidateForm]] = {}
    for candidate in candidate_library(twin, landscape.x):
        source = sources(twin)[candidate.source]
        is_constant = kind == "constant" and source.kind in (
            SourceKind.SIGNAL,
            SourceKind.SPEED,
        )  # only its noise changes
        own = candidate.model is model and candidate.site < len(twin.sites)
        if own and not is_constant and not is_a_parameter(sites(twin)[candidate.site].name, model.name, source.name):
            candidates.setdefault(candidate.site, []).append(candidate)
    if not candidates:
        return None
    of_site = candidates[int(random.choice(sorted(candidates)))]
    return of_site[int(random.integers(len(of_site)))]


def _inner(structure: CandidateForm, random: np.random.Generator) -> float:
    if structure.model.inner is None:
        return 0.0
    low, high = structure.bounds
    while True:
        inside = min(INNER_MARGIN, (high / low) ** 0.25)
        value = float(np.exp(random.uniform(np.log(low * inside), np.log(high / inside))))
        if structure.model.name != "power" or not NEARLY_LINEAR[0] < value < NEARLY_LINEAR[1]:
            return value


def _truth(
    structure: CandidateForm, times: float, landscape: LinearResponse, random: np.random.Generator
) -> Truth | None:
    """A component with ``times`` the amplitude of the detection limit.

    None if its effect would be too large, or if no machine could have it: friction that drives.
    """
    twin, model = problem().base_model, structure.model
    two = len(model.phases) > 1
    inner, phase = _inner(structure, random), float(random.uniform(-np.pi, np.pi)) if two else 0.0
    limit = detection_limit(structure, inner, phase, landscape)
    sign = 1.0 if two else float(random.choice([-1.0, 1.0]))
    site, source = sites(twin)[structure.site].name, sources(twin)[structure.source].name
    truth = Truth(site, model.name, source, sign * times * limit, inner, phase)
    try:
        largest = max(abs(truth.amplitude * truth.shape(float(x))) for x in landscape.x[structure.source])
    except OverflowError:
        return None
    if model.name == "Stribeck":  # its effect at rest; a window far from rest shows only the tail
        largest = abs(truth.amplitude)
    moments, parameters = landscape.window.grid.offsets, landscape.parameters
    low, high = PhysicalRange(twin, landscape.x, moments, parameters).amplitudes(structure, inner)
    return truth if largest <= MAX_EFFECT[truth.site == SHAFT] and low <= truth.amplitude <= high else None


def detection_limit(structure: CandidateForm, inner: float, phase: float, landscape: LinearResponse) -> float:
    """Amplitude in the unit of the site; infinite if parameters explain the component."""
    numbers = len(structure.model.phases) + (structure.model.inner is not None)
    own = len(problem().base_model.sites)
    alternatives = sum(1 for candidate in candidate_library(problem().base_model, landscape.x) if candidate.site < own)
    required = numbers * math.log(landscape.objective.count) + 2.0 * math.log(3.0 * alternatives) + DECISIVE
    return math.sqrt(required / max(_information(structure, inner, phase, landscape), 1e-300))


def _information(structure: CandidateForm, inner: float, phase: float, landscape: LinearResponse) -> float:
    """Information about the amplitude: gain of the fit per squared amplitude, independent of the noise."""
    at_phase = structure._replace(model=replace(structure.model, phases=(phase,)))
    curve = basis_functions([(at_phase, inner)])
    gains = landscape.score_responses(landscape.responses(curve))
    amplitude: float = gains.amplitudes[0, 0]
    return float(gains.gain[0] / amplitude**2) if amplitude else 0.0


def _is_distinguishable(truth: Truth, structure: CandidateForm, window: Window, known: Prior) -> bool:
    """Whether the candidate is in the library for this window, and its inner number within the bounds."""
    values: Array = window.values
    if not np.isfinite(values).all() or float(np.abs(values).max()) > 100.0:
        return False
    x = screen(problem(), window, known).response.x
    for candidate in candidate_library(problem().base_model, x):
        if (candidate.site, candidate.model, candidate.source) == (structure.site, structure.model, structure.source):
            low, high = candidate.bounds
            return structure.model.inner is None or low <= truth.inner <= high
    return False


def _screened(window: Window, known: Prior) -> ScreeningResult:
    return screen(problem(), window, known)
