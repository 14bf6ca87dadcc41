"""Random components for the motor, as large as can just be seen and up to thirty times larger.

The detection limit is the amplitude whose gain in -2 log evidence, expected from the linear picture of a healthy
window of the same operation, equals what the search asks for: amplitude² * information = numbers * log(values) +
2 log(3 rivals) + CLEARLY. The information is what is left of the unit response beside parameters, trends and initial
state, with all that is known of them; rivals are the structures of the machine (not of its sensors) in that window.
"""

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.discovery.motor import Faults, live, windows
from benchmarks.discovery.setting import looked, prior, problem
from benchmarks.discovery.truth import SHAFT, Truth, is_a_parameter
from otolith.acquisition.window import Array, Window
from otolith.discovery.candidates import CLEARLY
from otolith.discovery.linear_response import BasisFunctions, CandidateForm, LinearResponse, candidate_library
from otolith.discovery.search import ScreeningResult
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.augmented import base_model
from otolith.twin.augmentation import sites, sources
from otolith.twin.component_families import COMPONENT_FAMILIES, ComponentFamily, SourceKind, family_code

SECONDS = 2.0
LEAST, MOST = 3.0, 30.0  # of the detection limit
KINDS = ("steps", "constant", "sweep", "reversing")
SUITS = {"logarithmic": ("steps", "sweep"), "Coulomb": ("reversing",), "Stribeck": ("steps", "sweep", "reversing")}
INSIDE = 1.3  # how far an inner number stays away from the ends of what a window can show
NEARLY_LINEAR = (0.75, 1.3)  # exponents in which a power is hardly told from a parameter, so they are not drawn
LARGEST = {True: 0.1, False: 10.0}  # N·m on the shaft, V in the winding: more than that is no fault but another motor
ATTEMPTS = 200


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A component and the window it is to be found in."""

    number: int
    kind: str
    """Of operation."""
    times: float
    """Of the detection limit."""
    truth: Truth
    prior: Prior
    window: Window
    false_gain: float
    """Of a glance at the healthy window of the same operation."""


def draw(number: int, seed: int) -> Case:
    """The case of that number; the families take turns.

    Raises:
        RuntimeError: nothing of the family could be seen in any operation.
    """
    random = np.random.default_rng([seed, number])
    model = COMPONENT_FAMILIES[number % len(COMPONENT_FAMILIES)]
    for _ in range(ATTEMPTS):
        found = _attempt(number, model, random)
        if found is not None:
            return found
    raise RuntimeError(f"no case of family {model.name!r} in {ATTEMPTS} attempts")


def _attempt(number: int, model: ComponentFamily, random: np.random.Generator) -> Case | None:
    kind, operation = str(random.choice(SUITS.get(model.name, KINDS))), int(random.integers(2**31))
    known = prior(random)
    healthy = recorded(kind, Faults(), operation)
    seen = looked(problem(), healthy, known)
    chosen = _chosen(model, kind, seen.landscape, random)
    if chosen is None:
        return None
    times = float(np.exp(random.uniform(np.log(LEAST), np.log(MOST))))
    truth = _truth(chosen, times, seen.landscape, random)
    if truth is None:
        return None
    try:
        window = recorded(kind, truth.faults(), operation)
    except OverflowError:  # the motor ran away
        return None
    if not _is_there(truth, chosen, window, known):
        return None
    return Case(number, kind, times, truth, known, window, seen.gain)


def recorded(kind: str, faults: Faults, operation: int) -> Window:
    """One window; ``operation`` seeds set-points and noise."""
    return windows(live(kind, SECONDS, faults, operation))[0]


def _chosen(
    model: ComponentFamily, kind: str, landscape: LinearResponse, random: np.random.Generator
) -> CandidateForm | None:
    """A structure of the family that this operation shows and that is no parameter; sites are as likely."""
    twin = base_model(problem())
    found: dict[int, list[CandidateForm]] = {}
    for entry in candidate_library(twin, landscape.x):
        source = sources(twin)[entry.source]
        still = kind == "constant" and source.kind is SourceKind.SIGNAL  # only its noise moves
        own = entry.model is model and entry.site < len(twin.sites)
        if own and not still and not is_a_parameter(sites(twin)[entry.site].name, model.name, source.name):
            found.setdefault(entry.site, []).append(entry)
    if not found:
        return None
    of_site = found[int(random.choice(sorted(found)))]
    return of_site[int(random.integers(len(of_site)))]


def _inner(structure: CandidateForm, random: np.random.Generator) -> float:
    if structure.model.inner is None:
        return 0.0
    low, high = structure.bounds
    while True:
        inside = min(INSIDE, (high / low) ** 0.25)
        found = float(np.exp(random.uniform(np.log(low * inside), np.log(high / inside))))
        if structure.model.name != "power" or not NEARLY_LINEAR[0] < found < NEARLY_LINEAR[1]:
            return found


def _truth(
    structure: CandidateForm, times: float, landscape: LinearResponse, random: np.random.Generator
) -> Truth | None:
    """With an amplitude of so many ``times`` the detection limit, or nothing where that would be another motor."""
    twin, model = base_model(problem()), structure.model
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
    if model.name == "Stribeck":  # what it is at rest, or else a window far from rest shows the tail of a mountain
        largest = abs(truth.amplitude)
    return truth if largest <= LARGEST[truth.site == SHAFT] else None


def detection_limit(structure: CandidateForm, inner: float, phase: float, landscape: LinearResponse) -> float:
    """Amplitude in the unit of the site; infinite for what parameters do as well."""
    numbers = len(structure.model.phases) + (structure.model.inner is not None)
    own = len(base_model(problem()).sites)
    rivals = sum(1 for entry in candidate_library(base_model(problem()), landscape.x) if entry.site < own)
    asked = numbers * math.log(landscape.objective.count) + 2.0 * math.log(3.0 * rivals) + CLEARLY
    return math.sqrt(asked / max(_information(structure, inner, phase, landscape), 1e-300))


def _information(structure: CandidateForm, inner: float, phase: float, landscape: LinearResponse) -> float:
    """Of the amplitude: what a fit gains by the square of what it finds, whatever the noise happens to be."""
    curve = BasisFunctions(
        np.array([family_code(structure.model.name)]),
        np.array([structure.source]),
        np.array([structure.site]),
        np.array([inner]),
        np.array([phase]),
    )
    gains = landscape.gains(landscape.responses(curve), np.zeros((1, 2), dtype=np.int64))
    amplitude: float = gains.amplitudes[0, 0]
    return float(gains.gain[0] / amplitude**2) if amplitude else 0.0


def _is_there(truth: Truth, structure: CandidateForm, window: Window, known: Prior) -> bool:
    """Whether the window lets this structure be told, and its inner number lies within what it can show."""
    values: Array = window.values
    if not np.isfinite(values).all() or float(np.abs(values).max()) > 100.0:
        return False
    x = _seen(window, known).landscape.x
    for entry in candidate_library(base_model(problem()), x):
        if (entry.site, entry.model, entry.source) == (structure.site, structure.model, structure.source):
            low, high = entry.bounds
            return structure.model.inner is None or low <= truth.inner <= high
    return False


def _seen(window: Window, known: Prior) -> ScreeningResult:
    return looked(problem(), window, known)
