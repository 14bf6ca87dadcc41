"""What is known across windows: the filter's posterior of a problem's free parameters, and the phases of components.

The phase of a periodic component counts from the first record of a window. Between windows it advances by frequency
times time, or by order times shaft angle. A tracked component therefore stays coherent, and its frequency becomes ever
more certain. Where the advance is not known, the phase is reset to unknown.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation import imm_filter
from otolith.estimation.imm_filter import ADDED_LEVEL, ImmPosterior, Innovation
from otolith.estimation.information import QUANTILE, Evidence, Prior, initial_prior
from otolith.estimation.objective import converter_steps
from otolith.estimation.problem import INNER_BOUND, Problem, indices, source_of, without

START_TOLERANCE = 0.5  # mean steps by which a window may start early or late and still follow its predecessor
MAX_KNOWN_PHASE_SD = 1.0  # rad: a phase less certain than this counts as unknown
UNKNOWN_PHASE_SD = np.pi / np.sqrt(3.0)  # rad: standard deviation of the uniform distribution over a turn
PHASE_OFFSETS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)  # rad: added to unknown phases, one for each start of a fit
MAX_AGE = 600.0  # s for which a component over time that is not periodic is kept: later it is a trend of a parameter


@dataclass(frozen=True, slots=True)
class PhaseAdvance:
    """How far the sources of the components moved from the first record of a window to that of the next."""

    start: float  # Service time of the window's first record, s
    next_start: float  # That of the next window's first record, if no window is missing between
    by: tuple[float, ...]  # Of each slot, in the unit of its source
    last_state: tuple[float, ...] = ()  # State of the twin at the last record of the window; empty if it is not known


def phase_advance(problem: Problem, window: Window, last_state: Array) -> PhaseAdvance:
    """Return the advance over ``window``; ``last_state`` (states,) is the state at its last record."""
    names = [state.name for state in problem.twin.states]
    advance = []
    for component in problem.components:
        symbol = source_of(problem.base_model, component.source).symbol
        if component.source == "t":
            advance.append(window.grid.length)
        elif component.periodic and symbol.startswith("_"):
            speed = last_state[names.index(symbol.removeprefix("_angle_"))]
            advance.append(float(last_state[names.index(symbol)] + speed * window.grid.steps[-1]))
        else:
            advance.append(0.0)
    known = tuple(last_state[: len(problem.base_model.states)].tolist())
    return PhaseAdvance(window.start, window.end, tuple(advance), known if np.isfinite(known).all() else ())


@dataclass(frozen=True, eq=False)  # no slots: the prior is computed once
class Posterior:
    """What is known of the free parameters of ``problem``. Plain: it pickles."""

    problem: Problem
    belief: ImmPosterior  # Relative to the sizes of the parameters
    phase: PhaseAdvance | None = None  # None before the first window
    constant: ImmPosterior | None = None
    """The mode of constants. None before the first window, and after anything but a window
    has changed the belief: the next window begins it anew."""

    @classmethod
    def initial(cls, problem: Problem) -> "Posterior":
        """Return what is known before the first window."""
        prior, size = initial_prior(problem), _size(problem)
        return cls(problem, imm_filter.initial_modes(prior.mean / size, prior.covariance / np.outer(size, size)))

    def predict(self, window: Window) -> "Posterior":
        """Return the prediction: phases at the first record of ``window``, parameters at its end."""
        last = self._propagate_phases(window.start, window.sample_period)
        mode = last.constant or imm_filter.constant_mode(last.belief)
        return replace(
            last,
            belief=imm_filter.predict(last.belief, window.end),
            constant=imm_filter.predict_constants(mode, last.belief, window.end),
        )

    def at_last_record(self) -> "Posterior":
        """Return the same with phases at the last record of the last window, where :attr:`PhaseAdvance.last_state` is.

        The last step of that window counts as the sample period.
        """
        phase, problem = self.phase, self.problem
        step = problem.window.sample_period or 0.0
        if phase is None:
            return self
        by = []
        for component, advance in zip(problem.components, phase.by, strict=True):
            symbol = source_of(problem.base_model, component.source).symbol
            names = [state.name for state in problem.base_model.states]
            speed = symbol.removeprefix("_angle_")
            rate = phase.last_state[names.index(speed)] if speed in names and phase.last_state else 0.0
            by.append(advance - step * (rate if symbol.startswith("_angle_") else 1.0))
        last = replace(phase, next_start=phase.next_start - step, by=tuple(by))
        return replace(replace(self, phase=last)._propagate_phases(last.next_start, max(step, 1e-9)), phase=phase)

    def propagate_phases(self, advance: PhaseAdvance, window: Window) -> "Posterior":
        """Return the same with phases at the first record of ``window``, which ``advance`` leads to."""
        moved = replace(self, phase=advance)._propagate_phases(window.start, window.sample_period)
        return replace(moved, phase=self.phase)

    def prior(self) -> Prior:
        """Return all modes as one normal distribution, in the units of the parameters."""
        return self._prior

    @cached_property
    def _prior(self) -> Prior:
        size = _size(self.problem)
        mean, covariance = imm_filter.moment_match(self.belief)
        return Prior(mean * size, covariance * np.outer(size, size))

    def held(self, predicted: "Posterior") -> Prior:
        """Return what is known at the end of a window that does not update it; ``predicted`` is its prediction.

        Values stay, and what their trends would have added is added to the uncertainty. Values of components, whose
        phases advance, are those of the prediction.
        """
        before, after = self.prior(), predicted.prior()
        mean, kept = after.mean.copy(), [not free.name.startswith("_") for free in self.problem.free]
        values = np.flatnonzero(kept)
        moved = np.zeros(len(mean))
        moved[values] = mean[values] - before.mean[values]
        return Prior(mean - moved, after.covariance + np.diag(moved**2))

    def start(self) -> Array:
        """Return the parameters (free,) at which a fit starts: the mean, within the bounds."""
        return np.clip(self.prior().mean[: len(self.problem.free)], *self.problem.bounds)

    def with_phases(self, start: Array) -> list[Array]:
        """Return the starts of a fit: ``start`` (free,), or four with different phases where a phase is unknown."""
        unknown, starts = self.unknown_phases(), []
        for turn in PHASE_OFFSETS if unknown else (0.0,):
            starts.append(start.copy())
            starts[-1][unknown] += turn
        return starts

    def unknown_phases(self) -> list[int]:
        """Return where phases that are unknown stand among the free parameters."""
        problem = self.problem
        phases = [indices(problem, slot)[-1] for slot, item in enumerate(problem.components) if item.periodic]
        sd = np.sqrt(self.belief.covariance[0].diagonal()[: len(problem.free)]) * problem.scale
        return [phase for phase in phases if sd[phase] > MAX_KNOWN_PHASE_SD]

    def innovation(self, evidence: Evidence) -> Innovation:
        """Return the innovation of a window, of which this is the prediction."""
        size = _size(self.problem)
        relative = Evidence(evidence.point / size, evidence.sqrt_information * size, evidence.residual)
        return imm_filter.innovation_of(self.belief, relative)

    def shifts(self, values: Array, sd: Array, trend_response: Array, length: float) -> Array:
        """Return by how many standard deviations a window of ``length`` (s) alone differs from the prediction (free,).

        ``values`` and ``sd`` (free,) are its estimates without trends. A trend of a parameter moves them all, by
        ``trend_response`` (free, free) s. For a healthy machine a shift is a standard normal deviate, or smaller. It is
        zero for values of components, and where the difference is no larger than the drift within the window: the
        filter lags behind a drift that accelerates.
        """
        prior, free = self.prior(), len(self.problem.free)
        trend, sd_of_trend = prior.mean[free:], prior.sd[free:]
        expected = np.concatenate([np.eye(free), trend_response], axis=1)
        difference = values - expected @ prior.mean
        drift = length * np.maximum(np.abs(trend) - QUANTILE * sd_of_trend, 0.0)
        variance = self.belief.variance_ratio * sd**2 + (expected @ prior.covariance @ expected.T).diagonal()
        counted = np.isfinite(variance) & (np.abs(difference) > drift)
        counted &= [not parameter.name.startswith("_") for parameter in self.problem.free]
        return np.where(counted, difference / np.sqrt(np.where(counted, variance, 1.0)), 0.0)

    def update(self, innovation: Innovation, phase: PhaseAdvance) -> "Posterior":
        """Return the posterior after a window with that ``innovation``, which holds its prediction.

        Inner parameters of components stay within the bounds of their search, widened by ``INNER_BOUND``: far beyond
        them a shape means something else.
        """
        beliefs = [imm_filter.update(innovation)]
        if self.constant is not None:
            beliefs.append(imm_filter.update_constants(self.constant, innovation))
        for slot, component in enumerate(self.problem.components):
            if component.model.inner is not None:
                inner = indices(self.problem, slot)[1]
                low, high = component.low / INNER_BOUND, component.high * INNER_BOUND
                scale = float(self.problem.scale[inner])
                beliefs = [imm_filter.project(belief, inner, low / scale, high / scale) for belief in beliefs]
        return Posterior(self.problem, beliefs[0], phase, beliefs[1] if len(beliefs) > 1 else None)

    def with_constants(self) -> "Posterior":
        """Return the same with the mode of constants among those of the bank, for a prediction of what follows."""
        if self.constant is None:
            return self
        return replace(self, belief=imm_filter.with_constants(self.belief, self.constant), constant=None)

    def moved(self, change: Array) -> "Posterior":
        """Return the same with parameters and trends moved by ``change`` (2 free,), in their units."""
        belief = replace(self.belief, mean=self.belief.mean + change / _size(self.problem))
        return replace(self, belief=belief, constant=None)

    def set_prior(self, prior: Prior) -> "Posterior":
        """Return the same modes, each with ``prior`` as its distribution."""
        size = _size(self.problem)
        belief = imm_filter.set_all_modes(self.belief, prior.mean / size, prior.covariance / np.outer(size, size))
        return replace(self, belief=belief, constant=None)

    def with_noise(self, problem: Problem, inflation: Array) -> "Posterior":
        """Return the same for a ``problem`` with other noise; standard deviations grow by factors (2 free,).

        The variance ratio is one: the noise explains what windows disagreed in.
        """
        covariance = self.belief.covariance * np.outer(inflation, inflation)
        belief = replace(self.belief, covariance=covariance, variance_ratio=1.0)
        return replace(self, problem=problem, belief=belief, constant=None)

    def reset_value(self, index: int, value: float, sd: float) -> "Posterior":
        """Return the same with an independent ``value`` ± ``sd`` of one parameter or trend, in its unit."""
        scale = _size(self.problem)[index]

        def given(belief: ImmPosterior) -> ImmPosterior:
            return imm_filter.reset_marginal(belief, index, sd / scale, value / scale)

        is_trend = index >= len(self.problem.free)  # the mode of constants has none
        return replace(self, belief=given(self.belief)) if is_trend else self._with_each(given)

    def reset_parameters(self, moved: Iterable[int]) -> "Posterior":
        """Return the same with the initial prior for the parameters at the indices ``moved``, and for their trends.

        Windows agreed on constant parameters: unlike one that a single window shows to have moved
        (:func:`forget_parameter`), they are on no fast ramp, and a wider trend would cost accuracy.
        """
        belief, prior, size = self.belief, initial_prior(self.problem), _size(self.problem)
        for index in moved:
            for at in (index, index + len(self.problem.free)):
                sd = float(np.sqrt(prior.covariance[at, at]) / size[at])
                value = float(prior.mean[at] / size[at])
                belief = imm_filter.reset_marginal(belief, at, sd, value)
        return replace(self, belief=belief, constant=None)

    def forget_phase(self, index: int) -> "Posterior":
        """Return the same with the phase at ``index`` unknown."""
        return self._with_each(lambda belief: _forget_phase(belief, self.problem, index))

    def remap_parameters(self, problem: Problem) -> "Posterior":
        """Return what is known for another choice of free parameters; new ones have the initial prior."""
        labels, count = [free.label for free in self.problem.free], len(problem.free)
        new = [at for at, free in enumerate(problem.free) if free.label in labels]
        old = [labels.index(problem.free[at].label) for at in new]  # slots may have changed places
        level = np.full(count, ADDED_LEVEL)
        level[new] = self.belief.level[0][old]
        new, old = [*new, *(count + at for at in new)], [*old, *(len(labels) + at for at in old)]  # and their trends
        ratio = _size(self.problem)[old] / _size(problem)[new]
        old_mean, old_covariance = imm_filter.moment_match(self.belief)
        mean, covariance = imm_filter.moment_match(Posterior.initial(problem).belief)
        mean[new] = old_mean[old] * ratio
        covariance[new, :] = covariance[:, new] = 0.0
        covariance[np.ix_(new, new)] = old_covariance[np.ix_(old, old)] * np.outer(ratio, ratio)
        modes = imm_filter.equal_modes(level, mean, covariance, self.belief.end, self.belief.variance_ratio)
        return replace(self, problem=problem, belief=modes, constant=None)

    def without_slot(self, slot: int) -> "Posterior":
        """Return what is known without the component of a slot; the others keep their values."""
        remapped = self.remap_parameters(without(self.problem, self.problem.components[slot]))
        if self.phase is None:
            return remapped
        by = tuple(advance for index, advance in enumerate(self.phase.by) if index != slot)
        return replace(remapped, phase=replace(self.phase, by=by))

    def marginal_without(self, slot: int) -> "Posterior":
        """Return the same modes without the values of the component of a slot, for a prediction of what follows.

        :meth:`without_slot` is for windows to come: there all modes begin with the same probability.
        """
        fewer = self.without_slot(slot)
        labels, count = [free.label for free in self.problem.free], len(self.problem.free)
        kept = [labels.index(free.label) for free in fewer.problem.free]
        both = [*kept, *(count + at for at in kept)]
        ratio = _size(self.problem)[both] / _size(fewer.problem)

        def marginal(belief: ImmPosterior) -> ImmPosterior:
            covariance = belief.covariance[:, both][:, :, both] * np.outer(ratio, ratio)
            return replace(
                belief, level=belief.level[:, kept], mean=belief.mean[:, both] * ratio, covariance=covariance
            )

        modes = self._with_each(marginal)
        return replace(modes, problem=fewer.problem, phase=fewer.phase)

    def with_steps(self, window: Window) -> "Posterior":
        """Return the posterior with the steps of converters that ``window`` shows."""
        steps = converter_steps(self.problem, window)
        return self if steps == self.problem.steps else replace(self, problem=replace(self.problem, steps=steps))

    def without_expired(self, start: float) -> "Posterior":
        """Return what is known without components over time that are not periodic and too old at ``start``.

        ``start`` is a service time, s. What lasts longer is a trend of a parameter. A component from the future means
        that a log begins again; it leaves as well.
        """
        posterior = self
        for component in self.problem.components:
            is_trend = component.source == "t" and not component.periodic
            if is_trend and not 0.0 <= start - component.origin <= MAX_AGE:
                posterior = posterior.without_slot(posterior.problem.components.index(component))
        return posterior

    def _with_each(self, change: Callable[[ImmPosterior], ImmPosterior]) -> "Posterior":
        """Return the same with ``change`` made to the bank and to the mode of constants."""
        return replace(
            self, belief=change(self.belief), constant=None if self.constant is None else change(self.constant)
        )

    def _propagate_phases(self, start: float, sample_period: float) -> "Posterior":
        problem, phase, moved = self.problem, self.phase, self
        if phase is None:
            return self
        follows = abs(start - phase.next_start) <= START_TOLERANCE * sample_period
        for slot, (component, advance) in enumerate(zip(problem.components, phase.by, strict=True)):
            if not component.periodic:
                continue
            elapsed = start - phase.start
            if component.source == "t" and _stays_coherent(moved.belief, problem, slot, elapsed):
                moved = moved._advance_phase(slot, elapsed)
            elif component.source == "t":
                moved = moved.forget_phase(indices(problem, slot)[-1])
            elif follows:
                moved = moved._advance_phase(slot, advance)
            elif source_of(problem.base_model, component.source).symbol.startswith("_"):
                moved = moved.forget_phase(indices(problem, slot)[-1])
        return moved

    def _advance_phase(self, slot: int, by: float) -> "Posterior":
        """Return the same with the phase of a slot advanced by its inner parameter times ``by``, within one turn."""
        problem, free = self.problem, len(self.problem.free)
        _, inner, phase = indices(problem, slot)
        move = np.eye(2 * free)
        move[phase, inner] = move[free + phase, free + inner] = by * problem.scale[inner] / problem.scale[phase]
        turn = 2.0 * np.pi / problem.scale[phase]
        turns = turn * np.rint((self.belief.mean @ move.T)[0, phase] / turn)  # as many in the mode of constants

        def advanced(belief: ImmPosterior) -> ImmPosterior:
            mean = belief.mean @ move.T
            mean[:, phase] -= turns
            return replace(belief, mean=mean, covariance=move @ belief.covariance @ move.T)

        return self._with_each(advanced)


def _size(problem: Problem) -> Array:
    """Return the sizes (2 free,) of parameters and trends."""
    return np.concatenate([problem.scale, problem.scale])


def _stays_coherent(belief: ImmPosterior, problem: Problem, slot: int, elapsed: float) -> bool:
    """Whether the frequency is known well enough to predict the phase; never if a log begins again."""
    inner = indices(problem, slot)[1]
    sd = float(np.sqrt(belief.covariance[:, inner, inner].max())) * problem.scale[inner]
    return elapsed >= 0.0 and sd * elapsed < UNKNOWN_PHASE_SD


def _forget_phase(belief: ImmPosterior, problem: Problem, phase: int) -> ImmPosterior:
    return imm_filter.reset_marginal(belief, phase, UNKNOWN_PHASE_SD / problem.scale[phase])
