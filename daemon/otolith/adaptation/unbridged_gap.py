"""A gap of an input that the twin cannot bridge: what the input did there leaves every parameter too uncertain.

Outputs that are missing cost information, and the intervals show it. An input that is missing drives the twin in an
unknown way; the variance of its bridge becomes process noise. If that noise is the only reason why a window determines
no parameter, the window is refused and the gap is named.
"""

from dataclasses import replace

from otolith.acquisition.quality import Gap, longest_gap, time_text
from otolith.acquisition.window import Window
from otolith.estimation.information import QUANTILE, Identifiability, information
from otolith.estimation.objective import Objective
from otolith.estimation.window_fit import WindowEstimate

MIN_SHARE = 0.05  # of a window: a shorter gap is not named; engineering choice


def unbridged_gap(estimated: WindowEstimate) -> str:
    """Return which gap makes the window of an estimate useless, and the remedy; empty if none does."""
    window, problem = estimated.fit.window, estimated.fit.problem
    error = window.bridge_error
    if error is None or not error.held_variance.any():
        return ""
    if any(item.identifiability is Identifiability.DETERMINED for item in estimated.parameters):
        return ""
    gaps = {
        source.name: _longest_uncertain_gap(window, source.name)
        for source in problem.twin.inputs
        if source.name in window.signals
    }
    name = max(gaps, key=lambda name: gaps[name].length, default="")
    if not name or gaps[name].length < MIN_SHARE * window.grid.length or not _determines_without(estimated):
        return ""
    where = f"{name} has no sample for {gaps[name].length:.4g} s from {time_text(gaps[name].start)}"
    remedy = "look at its source, or accept less with [estimation] determined_within"
    return f"{where}, and no parameter can be determined within what is asked for: {remedy}"


def _longest_uncertain_gap(window: Window, name: str) -> Gap:
    """Return the longest time without a sample in which the input is uncertain."""
    uncertain = window.missing_in(name)
    if window.bridge_error is not None:
        uncertain = uncertain & (window.bridge_error.held_variance[:, window.signals.index(name)] > 0.0)
    return longest_gap(~uncertain, window.grid, window.start, window.sample_period)


def _determines_without(estimated: WindowEstimate) -> bool:
    """Whether the window would determine a parameter if all inputs were known."""
    problem, parameters = estimated.fit.problem, estimated.fit.parameters
    known = replace(estimated.fit.window, bridge_error=None)
    objective = Objective(problem, known, parameters)
    _, jacobian = objective.linearise(objective.guess(parameters))
    sd = information(jacobian, objective.high - objective.low, 1.0).sd[: objective.free]
    return bool((QUANTILE * sd <= problem.determined_within * problem.scale).any())
