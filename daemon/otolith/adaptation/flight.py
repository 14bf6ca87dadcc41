"""Particle swarms for the inner numbers of many meta-models at once (Eq. 1-2 of the paper).

Each structure has a swarm of its own, and all fly together: what a generation costs is one call of a compiled kernel,
where an optimiser called for each would keep books for longer than the kernel computes. Amplitudes need no search, they
enter linearly; so a swarm flies in one dimension.
"""

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.dictionary import Structure, shapes
from otolith.adaptation.landscape import Gains, Landscape
from otolith.adaptation.problem import SwarmOptions

PARTICLES, GENERATIONS = 10, 12
CALMED = 0.3  # the inertia weight falls to it: held at the paper's 0.9 a swarm does not come to rest
BLURRED = 0.5  # lines of the spectrum, or steps of a grid, by which particles are scattered around where they begin


def evaluated(landscape: Landscape, guesses: list[tuple[Structure, float]]) -> Gains:
    """What each guess, a structure and its inner number, would gain."""
    if not guesses:
        return Gains(np.zeros(0), np.zeros((0, 2)))
    counts = np.array([len(entry.model.phases) for entry, _ in guesses], dtype=np.int64)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    pairs = np.column_stack([first, first + counts - 1])
    return landscape.gains(landscape.responses(shapes(iter(guesses))), pairs)


def fly(
    landscape: Landscape, begun: list[tuple[Structure, Array, float]], options: SwarmOptions, seed: int
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
