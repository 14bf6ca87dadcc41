"""Components that no window shows alone, but all of the last windows together.

A weak component gains too little in one window to be worth a search, however often it returns. So the last windows are
kept and from time to time searched together, as those of a healthy record are: same component, and parameters that
differ from what was known by the same amount in all windows (see :mod:`otolith.commissioning.structure`). It is adopted
when two such searches find it. The second one contains a window that the first one has not seen.
``docs/explanation/discovery.md`` has the rules.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from otolith.acquisition.window import Window
from otolith.commissioning.structure import MIN_WINDOWS, PooledResponse, Structure, pooled_forms, structures
from otolith.discovery.candidate_forms import CandidateForm
from otolith.discovery.candidates import components_of
from otolith.discovery.linear_response import Guess
from otolith.discovery.noise_hypothesis import likelier_levels
from otolith.discovery.screening import DECISIVE, CompetingForms, ScoredGuesses
from otolith.estimation.arrival_cost import initial_prior
from otolith.estimation.problem import Problem, key_of
from otolith.estimation.window_fit import fit
from otolith.twin.components import positions, sites, sources

Starts = tuple[tuple[Window, tuple[float, ...], tuple[float, ...]], ...]
"""Windows, each with its initial state and with what was known of the parameters after it: they may drift."""


@dataclass(frozen=True, slots=True, eq=False)
class PooledWindows:
    """The last windows that updated the filter and showed nothing that the twin lacks."""

    windows: Starts = ()
    pause: int = MIN_WINDOWS  # Windows until the next search
    next_pause: int = MIN_WINDOWS  # The same after it
    shown: Structure | None = None  # By the last search
    confirmed: Structure | None = None  # By the last two: it is to be adopted


def lacking_component(problem: Problem, windows: Starts) -> Structure | None:
    """Return the component that ``windows`` show together most clearly, within its physical range; None if none.

    Noise that was stated larger than it is hides structure, so likelier levels are searched at. But what the
    stated noise covers may be a part of it: only a sine that stands out in its spectrum needs no evidence beside that.
    """
    response_at = cache(lambda levels: _pooled(levels, windows))
    quieter = likelier_levels(problem, lambda levels: _deviance(response_at(levels)))
    pooled = response_at(quieter)
    at_positions = positions(problem.base_model)
    forms = [form for form in pooled_forms(pooled) if form.source in at_positions]
    for shown in filter(lambda own: own.is_offered, structures(pooled, forms)):
        guess = next(form for form in forms if _key(pooled, form) == shown.component.key), shown.component.inner
        alone, stated = (_pooled(levels, windows) for levels in (quieter, problem))
        scored = ScoredGuesses.of(stated, [guess], CompetingForms.among(problem, forms))[0]
        is_shown = scored.score > DECISIVE or alone.is_line(scored)
        if (
            is_shown
            and not _may_be_of_sensor(alone, guess)
            and all(components_of(own, [scored]) for own in stated.parts)
        ):
            return shown
    return None


def _pooled(problem: Problem, windows: Starts) -> PooledResponse:
    """Return the response of the windows, each linearised at what was known of the parameters after it."""
    prior, trends = initial_prior(problem), np.zeros(len(problem.free))
    starts = ((window, state, np.concatenate([parameters, trends])) for window, state, parameters in windows)
    return PooledResponse([fit(problem, window, prior, start, 0, state=state) for window, state, start in starts])


def _deviance(pooled: PooledResponse) -> float:
    """Minus twice the log-likelihood of the process noise, up to a constant."""
    return pooled.chi_square + sum(part.objective.innovation_model.log_determinant for part in pooled.parts)


def _key(pooled: PooledResponse, form: CandidateForm) -> str:
    twin = pooled.problem.base_model
    return key_of(sites(twin)[form.site].name, form.model.name, sources(twin)[form.source].name)


def _may_be_of_sensor(pooled: PooledResponse, guess: Guess) -> bool:
    """Whether the error of an output's sensor would explain the windows as well, as that of an encoder."""
    (form, inner), twin = guess, pooled.problem.base_model
    outputs = {output.name for output in twin.outputs}
    read = [at for at, site in enumerate(sites(twin)) if at >= len(twin.sites) and site.into in outputs]
    of_sensors = [(form._replace(site=at), inner) for at in read]
    gains = pooled.score([guess, *of_sensors]).gain
    return bool((gains[1:] > gains[0] - DECISIVE).any())
