"""Candidates for components: all structures through the twin's linear response, their inner numbers by swarms.

Particle swarms for the inner numbers of many meta-models at once (Eq. 1-2 of the paper).

Each structure has a swarm of its own, and all fly together: what a generation costs is one call of a compiled kernel,
where an optimiser called for each would keep books for longer than the kernel computes. Amplitudes need no search, they
enter linearly; so a swarm flies in one dimension.
"""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.linear_response import (
    CandidateForm,
    LinearResponse,
    ScoreStatistics,
    basis_functions,
    candidate_library,
    grid,
)
from otolith.estimation.augmented import base_model
from otolith.estimation.problem import Component, Problem, SwarmOptions
from otolith.twin.augmentation import MAX_COMPONENTS, sites, sources

PARTICLES, GENERATIONS = 10, 12
CALMED = 0.3  # the inertia weight falls to it: held at the paper's 0.9 a swarm does not come to rest
BLURRED = 0.5  # lines of the spectrum, or steps of a grid, by which particles are scattered around where they begin


def evaluated(landscape: LinearResponse, guesses: list[tuple[CandidateForm, float]]) -> ScoreStatistics:
    """What each guess, a structure and its inner number, would gain."""
    if not guesses:
        return ScoreStatistics(np.zeros(0), np.zeros((0, 2)))
    counts = np.array([len(entry.model.phases) for entry, _ in guesses], dtype=np.int64)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    pairs = np.column_stack([first, first + counts - 1])
    return landscape.gains(landscape.responses(basis_functions(iter(guesses))), pairs)


def pso_search(
    landscape: LinearResponse, begun: list[tuple[CandidateForm, Array, float]], options: SwarmOptions, seed: int
) -> list[float]:
    """The best inner number of each structure, begun at (starts,) with steps of that size between them."""
    random = np.random.default_rng(seed)
    low, high = np.array([entry.bounds for entry, _, _ in begun]).T[:, :, None]
    steps = np.array([step for _, _, step in begun])[:, None]
    first = np.array([np.resize(starts, PARTICLES) for _, starts, _ in begun])
    blur = BLURRED * steps * random.uniform(-1.0, 1.0, first.shape)
    blur[:, 0] = 0.0
    place = np.clip(first + blur, low, high)
    speed = np.zeros_like(place)
    best, reached = place.copy(), np.full(place.shape, -np.inf)
    rows = np.arange(len(begun))
    for generation in range(GENERATIONS):
        guesses = [(entry, float(value)) for (entry, _, _), row in zip(begun, place, strict=True) for value in row]
        gain = evaluated(landscape, guesses).gain.reshape(place.shape)
        better = gain > reached
        best, reached = np.where(better, place, best), np.where(better, gain, reached)
        leader = best[rows, reached.argmax(axis=1)][:, None]
        inertia = options.inertia + (CALMED - options.inertia) * generation / (GENERATIONS - 1)
        own, common = random.random(place.shape), random.random(place.shape)
        speed = inertia * speed + options.cognitive * own * (best - place) + options.social * common * (leader - place)
        place = np.clip(place + speed, low, high)
    found: list[float] = best[rows, reached.argmax(axis=1)].tolist()
    return found


COARSE, FINE = 1.5, 0.5  # lines of the spectrum between two frequencies, in a glance and in a search
CLEARLY = 10.0  # in -2 log evidence: a Bayes factor of 150
PEAKS = 3  # of a spectrum, where a swarm begins
FLOWN, TRIED = 16, 10  # structures whose inner numbers are searched, and those that are polished
KEPT, RELATIVE = 23.0, 0.3  # in -2 log evidence, and as a share: what the linear picture may be wrong by
WORTH, FEWEST = 500, 4  # steps of the integrator in a window up to which all are tried, and what is tried at least
LARGEST = 1e9  # amplitude, in the unit of a site: nobody could read an equation with a larger one


Guess = tuple[CandidateForm, float]
Settled = tuple[Guess, Array, float]
"""A guess, its amplitudes, and its gain in -2 log evidence."""


def allowed_forms(problem: Problem, x: Array) -> list[CandidateForm]:
    """All that may be looked for where the sources are ``x`` (sources, records), while the twin has room for it.

    What is in the twin and what the specialist or the machine file excludes is left out. Where components are not
    looked for, the errors of sensors are.
    """
    twin = base_model(problem)
    if len(problem.components) >= MAX_COMPONENTS:
        return []
    taken = problem.excluded | {entry.key for entry in problem.components}
    own = len(twin.sites)
    return [entry for entry in candidate_library(twin, x, taken) if problem.discover or entry.site >= own]


def screened(
    landscape: LinearResponse, problem: Problem, found: list[CandidateForm], fineness: float
) -> tuple[list[Guess], Array, Array]:
    """Guesses on the grid, their amplitudes (guesses, 2), and their gains in -2 log evidence (guesses,)."""
    guesses = [(entry, float(inner)) for entry in found for inner in grid(entry, landscape.x, fineness)]
    gains = evaluated(landscape, guesses)
    return guesses, gains.amplitudes, scores_of(landscape, guesses, gains.gain, rivals_of(problem, found))


@dataclass(frozen=True, slots=True)
class Rivals:
    """How many structures there are."""

    own: int
    """Number of the first site that is a sensor."""
    of_machine: float
    of_sensors: float

    def of(self, structure: CandidateForm) -> float:
        """Of its kind."""
        return self.of_sensors if self.lies(structure) else self.of_machine

    def lies(self, structure: CandidateForm) -> bool:
        """Whether it is the error of a sensor."""
        return structure.site >= self.own


def rivals_of(problem: Problem, found: list[CandidateForm]) -> Rivals:
    """How many structures of each kind are among ``found``."""
    own = len(base_model(problem).sites)
    sensors = sum(entry.site >= own for entry in found)
    return Rivals(own, float(max(len(found) - sensors, 1)), float(max(sensors, 1)))


def scores_of(landscape: LinearResponse, guesses: list[Guess], gain: Array, rivals: Rivals) -> Array:
    """(guesses,) gains in -2 log evidence over parameters only."""
    records = landscape.objective.count
    counts = np.array([_numbers_of(entry) for entry, _ in guesses], dtype=np.float64)
    others = np.array([rivals.of(entry) for entry, _ in guesses])
    left = max((landscape.chi_square - float(gain.max(initial=0.0))) / records, 1.0)
    return np.asarray(gain / left - counts * np.log(records) - 2.0 * np.log(3.0 * others))


def _numbers_of(structure: CandidateForm) -> int:
    return len(structure.model.phases) + (structure.model.inner is not None)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A component worth a polish."""

    component: Component
    rivals: float
    """How many structures there are of its kind."""
    of_sensor: bool


def candidates(problem: Problem, landscape: LinearResponse, window: Window) -> list[Candidate]:
    """The components worth a polish, the best first."""
    found = allowed_forms(problem, landscape.x)
    rivals = rivals_of(problem, found)
    settled = _settled(problem, landscape, window, found, rivals)
    if not settled:
        return []
    best_score = settled[0][2]
    settled = _no_parameters(landscape, settled, rivals)
    least = max(best_score - KEPT - RELATIVE * abs(best_score), -CLEARLY)
    kept = [entry for entry in settled if entry[2] > least][: _affordable(landscape)]
    kept += threshold_like(problem, settled[len(kept) :]) if kept else []
    return [
        Candidate(component_of(problem, window, *guess, pair), rivals.of(guess[0]), rivals.lies(guess[0]))
        for guess, pair, _ in kept
        if 0.0 < np.abs(pair).max() < LARGEST
    ]


def _settled(
    problem: Problem, landscape: LinearResponse, window: Window, found: list[CandidateForm], rivals: Rivals
) -> list[Settled]:
    """The structures with the best inner numbers that swarms find, the best first; swarms fly for the leaders only."""
    guesses, amplitudes, scores = screened(landscape, problem, found, FINE)
    leaders: dict[CandidateForm, list[int]] = {}
    for index in np.argsort(-scores, kind="stable").tolist():
        leaders.setdefault(guesses[index][0], []).append(index)
    still = [places[0] for entry, places in leaders.items() if entry.model.inner is None]
    settled = [(guesses[place], amplitudes[place], float(scores[place])) for place in still]
    flown = [(entry, places) for entry, places in leaders.items() if entry.model.inner is not None][:FLOWN]
    if flown:
        begun = [(entry, np.array([guesses[place][1] for place in places[:PEAKS]]), _step(entry, landscape.x))
                 for entry, places in flown]  # fmt: skip
        inner = pso_search(landscape, begun, problem.swarm, problem.seed + window.index)
        arrived = [(entry, value) for (entry, _), value in zip(flown, inner, strict=True)]
        gains = evaluated(landscape, arrived)
        reached = scores_of(landscape, arrived, gains.gain, rivals)
        settled += zip(arrived, gains.amplitudes, map(float, reached), strict=True)
    return sorted(settled, key=lambda entry: -entry[2])


def _no_parameters(landscape: LinearResponse, settled: list[Settled], rivals: Rivals) -> list[Settled]:
    """Without components that do what a parameter would do; a sensor that lies may."""
    single = [len(guess[0].model.phases) == 1 for guess, _, _ in settled]
    heights = np.concatenate([pair[:1] if one else pair for (_, pair, _), one in zip(settled, single, strict=True)])
    same = landscape.is_parameter(basis_functions(iter(guess for guess, _, _ in settled)), heights)
    first = np.cumsum([0, *(1 if one else 2 for one in single[:-1])]).tolist()
    return [entry for entry, at in zip(settled, first, strict=True) if rivals.lies(entry[0][0]) or not same[at]]


def _affordable(landscape: LinearResponse) -> int:
    """How many candidates are polished: fewer in large windows, so that a search ends before the next one."""
    return int(np.clip(TRIED * WORTH / max(landscape.objective.work, 1), FEWEST, TRIED))


def threshold_like(problem: Problem, rest: list[Settled]) -> list[Settled]:
    """Of each site the best family that the linear picture underrates, of a state of the twin."""
    states = {entry.name for entry in base_model(problem).states}
    found: dict[int, Settled] = {}
    for entry in rest:
        structure = entry[0][0]
        if structure.model.threshold_like and sources(base_model(problem))[structure.source].name in states:
            found.setdefault(structure.site, entry)
    return list(found.values())


def _step(structure: CandidateForm, x: Array) -> float:
    points = grid(structure, x, FINE)
    return float(np.diff(points).min()) if len(points) > 1 else float(np.ptp(structure.bounds))


def component_of(problem: Problem, window: Window, structure: CandidateForm, inner: float, pair: Array) -> Component:
    """The component of a structure with its inner number and the amplitudes (2,) of the linear picture."""
    twin = base_model(problem)
    first, second = map(float, pair)
    two = len(structure.model.phases) > 1
    return Component(
        site=sites(twin)[structure.site].name,
        family=structure.model.name,
        source=sources(twin)[structure.source].name,
        amplitude=float(np.hypot(first, second)) if two else first,
        inner=inner,
        phase=float(np.arctan2(second, first)) if two else 0.0,
        low=structure.bounds[0],
        high=structure.bounds[1],
        origin=window.start,
    )
