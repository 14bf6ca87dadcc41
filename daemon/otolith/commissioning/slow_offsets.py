"""Offsets that grow slowly, as the zero of a sensor that drifts, against parameters that move.

Within one window an offset looks like other values of the parameters, and the filter follows it. But which values it
looks like depends on what the machine does: an offset of a current is a larger share of a smaller current. So windows
at several operating points together show which of the two has changed. What windows tell of both is kept in square-root
information form, and old windows are pooled. ``docs/explanation/discovery.md`` has the equations.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from otolith.acquisition.window import Array
from otolith.discovery.hypotheses import FaultHypothesis, FaultType, TrackedHypothesis
from otolith.discovery.linear_response import LinearResponse, basis_functions
from otolith.discovery.screening import allowed_forms
from otolith.discovery.sequential_test import MAX_TOTAL_DEVIANCE, FilterEvidence, SequentialTest, WindowCounts
from otolith.estimation.evidence import DECISIVE, discount, is_explained, likelihood_ratios, penalty
from otolith.estimation.information import INITIAL_TREND_SD
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, augment, indices
from otolith.estimation.window_fit import Fit
from otolith.twin.components import sites

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
MAX_BLOCKS = 32  # of windows that are kept: beyond it old ones are pooled in pairs
MIN_BLOCKS = 6  # with fewer, a parameter on a line with a kink explains everything
KINK_BLOCKS = 3  # after a kink: with fewer, a slope is an outlier
MIN_DIRECTION = 1e-9  # of the largest information: a direction with less is not determined


@dataclass(frozen=True, slots=True, eq=False)
class WindowBlock:
    """What consecutive windows tell of parameters and offsets, as if these were constant in them."""

    time: float  # s: their middle
    windows: int
    count: float  # Measured values
    root: Array
    """(rows, free + offsets + 1) triangular: of parameters relative to their sizes, of offsets, and the residual."""

    def with_later(self, other: "WindowBlock") -> "WindowBlock":
        """Return both in one."""
        windows = self.windows + other.windows
        time = (self.windows * self.time + other.windows * other.time) / windows
        root = np.asarray(np.linalg.qr(np.vstack([self.root, other.root]), mode="r"))
        return WindowBlock(time, windows, self.count + other.count, root)


@dataclass(frozen=True, slots=True, eq=False)
class GrownOffset:
    """An offset that has grown while all parameters have stayed as they were."""

    site: int  # Index among the sites of the twin
    values: Array
    """(free + 2,) parameters relative to their sizes, then growth and slope per second of the offset at the end."""
    sd: Array  # (free + 2,)
    onset: float  # s: when it began to grow
    chi_square: float


@dataclass(frozen=True, slots=True, eq=False)
class SlowChange:
    """What explains the windows."""

    offsets: tuple[GrownOffset, ...]  # Those that explain them equally, the best first
    unchanged: float  # χ² over that of the best offset, if nothing has changed
    moved: float  # The same, if parameters have moved
    windows: int  # Since the best offset began to grow


@dataclass(frozen=True, slots=True, eq=False)
class OffsetLedger:
    """The windows of a twin without components that it explains with some values of its parameters."""

    free: tuple[str, ...] = ()  # Labels of the parameters
    sites: tuple[int, ...] = ()  # Of the offsets
    blocks: tuple[WindowBlock, ...] = ()
    end: float = -np.inf  # s: of the last window
    is_open: bool = False  # Whether a test of offsets that the windows show is open

    def after(self, response: LinearResponse, inflation: float) -> "OffsetLedger":
        """Return the ledger with a window; ``inflation`` multiplies its standard deviations."""
        problem, window = response.problem, response.window
        forms = [
            form
            for form in allowed_forms(problem, response.x)
            if form.model.name == "constant" and sites(problem.base_model)[form.site].mode == "additive"
        ]
        labels, places = tuple(free.label for free in problem.free), tuple(form.site for form in forms)
        if not forms or problem.components:
            return OffsetLedger()
        root = response.information(basis_functions((form, 0.0) for form in forms)) / inflation
        if not np.isfinite(root).all():
            return self
        before = self if (self.free, self.sites) == (labels, places) and window.end > self.end else OffsetLedger()
        own = WindowBlock(window.start + 0.5 * window.grid.length, 1, response.count, root)
        return OffsetLedger(labels, places, _pooled((*before.blocks, own)), window.end, self.is_open)

    def without_other_changes(self) -> "OffsetLedger":
        """Return the ledger with its last windows only, if neither an offset nor moved parameters explain all."""
        is_full = len(self.blocks) > MIN_BLOCKS
        if self.is_open or not is_full or any(_Offset(self, at).is_explained for at in range(len(self.sites))):
            return self
        return replace(self, blocks=self.blocks[-MIN_BLOCKS:])

    def change(self) -> SlowChange | None:
        """Return the slow change of offsets that the windows show; None if they show none.

        It must explain them decisively better than moved parameters do, although these may follow a line with a kink.
        """
        if len(self.blocks) < MIN_BLOCKS:
            return None
        tried = sorted((_Offset(self, at) for at in range(len(self.sites))), key=lambda own: own.least)
        least, count = tried[0].least, sum(block.count for block in self.blocks)
        unchanged = min(own.unchanged for own in tried) - least
        if unchanged < DECISIVE + float(penalty(1.0, count, len(self.sites) * len(self.blocks))):
            return None
        moved = min(own.moved for own in tried) - least
        if moved < DECISIVE or not tried[0].is_explained:
            return None
        equal = tuple(own.grown for own in tried if own.least <= least + DECISIVE)
        windows = sum(block.windows for block in self.blocks if block.time >= equal[0].onset)
        return SlowChange(equal, unchanged, moved, windows)


def open_test(
    change: SlowChange, filtered: Posterior, tested: tuple[Posterior, Posterior], fitted: Fit
) -> tuple[Posterior, SequentialTest]:
    """Return the filter as if parameters had stayed, and the test of what has grown, after the window of ``fitted``.

    ``filtered`` is the filter before the window; ``tested`` its prediction, and the same updated with the window.
    """
    best, problem = change.offsets[0], filtered.problem
    predicted, updated = tested
    stayed = _with_constant(filtered, best)
    before, advance = _with_constant(predicted, best), fitted.advance()
    names = ", ".join(free.name for free in problem.free)
    null = FaultHypothesis(FaultType.NOTHING)
    moved = FaultHypothesis(FaultType.PARAMETER, names, len(problem.free))
    rows = [(null, replace(before, phase=advance), change.unchanged), (moved, updated, change.moved)]
    for own in change.offsets:
        site = sites(problem.base_model)[own.site]
        value, slope = own.values[-2:].tolist()
        component = Component(site.name, "constant", "", value, origin=own.onset)
        kind = FaultType.SENSOR if own.site >= len(problem.base_model.sites) else FaultType.COMPONENT
        stated = FaultHypothesis(kind, component.key, 1, float(len(change.offsets)))
        wider = augment(problem, [component])
        at, free = indices(wider, 0)[0], len(wider.free)
        posterior = before.remap_parameters(wider).reset_value(at, value, float(own.sd[-2]))
        posterior = posterior.reset_value(free + at, slope, float(own.sd[-1]))
        after = replace(advance, by=(*advance.by, 0.0))
        rows.append((stated, replace(posterior, phase=after), own.chi_square - best.chi_square))
    hypotheses = [
        TrackedHypothesis(stated, posterior, min(left, MAX_TOTAL_DEVIANCE), min(left, MAX_TOTAL_DEVIANCE), fitted.cost)
        for stated, posterior, left in rows
    ]
    counts = WindowCounts(change.windows, change.windows, change.windows, change.windows)
    against = FilterEvidence(MAX_TOTAL_DEVIANCE, MAX_TOTAL_DEVIANCE)
    hypotheses.sort(key=lambda item: item.deviance)
    return stayed, SequentialTest(problem, tuple(hypotheses), best.onset, counts=counts, filter_evidence=against)


def _with_constant(posterior: Posterior, best: GrownOffset) -> Posterior:
    """Return the posterior with the parameters of all windows."""
    problem, free = posterior.problem, len(posterior.problem.free)
    calm = replace(Posterior.initial(problem).belief, end=posterior.belief.end)
    posterior = replace(posterior, belief=calm)
    for at, (value, sd) in enumerate(zip(best.values[:free].tolist(), best.sd[:free].tolist(), strict=True)):
        scale = float(problem.scale[at])
        posterior = posterior.reset_value(at, scale * value, scale * sd)
        posterior = posterior.reset_value(free + at, 0.0, INITIAL_TREND_SD * scale)
    return posterior


def _pooled(blocks: tuple[WindowBlock, ...]) -> tuple[WindowBlock, ...]:
    """Return the blocks; beyond their limit, the oldest two neighbours of as many windows become one."""
    if len(blocks) <= MAX_BLOCKS:
        return blocks
    pairs = pairwise(blocks)
    at = next((at for at, (one, other) in enumerate(pairs) if one.windows <= other.windows), 0)
    return (*blocks[:at], blocks[at].with_later(blocks[at + 1]), *blocks[at + 2 :])


class _Offset:
    """The offset of one site and the parameters, fitted to all blocks."""

    def __init__(self, ledger: OffsetLedger, at: int) -> None:
        free, blocks = len(ledger.free), ledger.blocks
        roots = [block.root[:, [*range(free), free + at, -1]] for block in blocks]
        self._site, self._free, self._end = ledger.sites[at], free, ledger.end
        self._products: Array = np.array([root.T @ root for root in roots])  # (blocks, unknowns + 1, unknowns + 1)
        self._times = np.array([block.time for block in blocks])
        self._starts = self._times[: max(len(blocks) - KINK_BLOCKS, 1)]
        self._kinks = np.maximum(self._times - self._starts[:, None], 0.0)  # (kinks, blocks)

    @cached_property
    def unchanged(self) -> float:
        """χ² of constant parameters and a constant offset."""
        return float(self._solve([]).chi_square[0])

    @cached_property
    def moved(self) -> float:
        """χ² of parameters on a line with a kink, and a constant offset."""
        line, own = np.broadcast_to(self._times - self._times[0], self._kinks.shape), range(self._free)
        return float(self._solve([*((at, line) for at in own), *((at, self._kinks) for at in own)]).chi_square.min())

    @cached_property
    def _of_kinks(self) -> "_Solutions":
        """Constant parameters, and an offset that is constant until a kink."""
        return self._solve([(self._free, self._kinks)])

    @property
    def least(self) -> float:
        """Least χ² of an offset that has grown."""
        return float(self._of_kinks.chi_square.min())

    @property
    def is_explained(self) -> bool:
        """Whether an offset that has grown leaves no more than the noise of the blocks."""
        return is_explained(*self._left)

    @cached_property
    def _left(self) -> tuple[float, float]:
        """χ² beyond that of blocks with values of their own, and its degrees of freedom."""
        products = self._products
        alone = _solve_normal(products[:, :-1, :-1], -products[:, :-1, -1], products[:, -1, -1])
        chi_square = self.least - float(alone.chi_square.sum())
        degrees = int(alone.rank.sum()) - self._of_kinks.values.shape[1]
        return max(chi_square, 0.0), max(degrees, 1)

    @property
    def grown(self) -> GrownOffset:
        """The offset that has grown since a kink: the mean over all kinks, each as probable as it explains."""
        solutions = self._of_kinks
        since, slopes = (self._end - self._starts)[:, None], solutions.values[:, -1:]
        values = np.hstack([solutions.values[:, : self._free], since * slopes, slopes])
        own = np.hstack([solutions.sd[:, : self._free], since * solutions.sd[:, -1:], solutions.sd[:, -1:]])
        weights = likelihood_ratios(solutions.chi_square)
        weights /= weights.sum()
        mean = weights @ values
        sd = np.sqrt(weights @ (discount(*self._left) * own**2 + (values - mean) ** 2))
        least = int(solutions.chi_square.argmin())
        return GrownOffset(self._site, mean, sd, float(self._starts[least]), self.least)

    def _solve(self, more: list[tuple[int, Array]]) -> "_Solutions":
        """Return the solutions with ``more`` unknowns: each an entry of the blocks, with a shape (shapes, blocks)."""
        constants = range(self._free + 1)
        ones = np.ones_like(more[0][1] if more else self._times[None])
        entries = [*constants, *(at for at, _ in more)]
        weights = np.stack([*(ones for _ in constants), *(shape for _, shape in more)], axis=-1)
        products = self._products[:, entries]
        normal = np.einsum("bij,sbi,sbj->sij", products[:, :, entries], weights, weights)
        right = -np.einsum("bi,sbi->si", products[:, :, -1], weights)
        return _solve_normal(normal, right, float(self._products[:, -1, -1].sum()))


@dataclass(frozen=True, slots=True, eq=False)
class _Solutions:
    """Of normal equations."""

    values: Array  # (systems, unknowns)
    sd: Array  # (systems, unknowns)
    chi_square: Array  # (systems,)
    rank: Array  # (systems,)


def _solve_normal(normal: Array, right: Array, total: Array | float) -> _Solutions:
    """Return the solutions of ``normal`` (systems, unknowns, unknowns), without directions that are not determined."""
    size = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), np.finfo(float).tiny))
    eigenvalues, directions = np.linalg.eigh(normal / (size[:, :, None] * size[:, None, :]))
    kept = eigenvalues > MIN_DIRECTION * eigenvalues.max(axis=1, keepdims=True)
    inverse = np.where(kept, 1.0, 0.0) / np.where(kept, eigenvalues, 1.0)
    along = np.einsum("sui,su->si", directions, right / size)
    values = np.einsum("sui,si->su", directions, inverse * along) / size
    sd = np.sqrt(np.einsum("sui,si->su", directions**2, inverse)) / size
    return _Solutions(values, sd, total - (along**2 * inverse).sum(axis=1), kept.sum(axis=1))
