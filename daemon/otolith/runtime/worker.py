"""A worker process, which cuts one window at a time and adapts to it.

A worker is stateless: it receives state and samples, and returns window, next state and report. The state of record
stays with the daemon (:mod:`otolith.runtime.hall.machine`).

The daemon imports this module too, so what is large is imported only in the functions that run in the worker: the
adaptation core with its compiler and optimiser, and SciPy, which bridges inputs.
"""

import contextlib
import logging
import time
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from otolith import kernel_cache
from otolith.acquisition.window import Window
from otolith.adaptation.packed_state import PackedState
from otolith.adaptation.state import AdaptationState, with_problem
from otolith.health.schema import Report
from otolith.health.status import absent_sources
from otolith.runtime.hall.machine import Task, WorkerResult
from otolith.runtime.process import spare_collections

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
WARM_UP_RECORDS = 40  # of the random window that makes a new worker compile every kernel
WARM_UP_KERNELS = 11  # that a new worker compiles or loads


@dataclass(frozen=True, slots=True)
class Performed:
    """A window with its report and the next state; after a failure the unchanged state and no report."""

    window: Window | None  # None if it could not be cut
    state: AdaptationState
    report: Report | None
    seconds: float  # Computing time, s
    failure: str  # The exception, or an empty string


class Ready(NamedTuple):
    """The worker has started: sent once, before the first result."""


def main(connection: Any, packed: PackedState) -> None:
    """Serve in the worker process: receive (state, task) and send a result, until None comes.

    Each step of a kernel is sent as well, and :class:`Ready` once.
    """
    has_compiled = False

    def report(step: kernel_cache.CompileStep) -> None:
        nonlocal has_compiled
        has_compiled = True
        with contextlib.suppress(OSError):  # the daemon has died, which the next result notices
            connection.send(step)

    with kernel_cache.observed(report):
        warm_up(packed.unpack())
        spare_collections()
        connection.send(Ready())
        while (task := connection.recv()) is not None:
            connection.send(answer(*task))
            if has_compiled:
                kernel_cache.release_compiler()
                has_compiled = False


def answer(packed: PackedState, task: Task) -> WorkerResult:
    """Cut the window of a task and adapt to it; the next state has a plan only if it is another one."""
    performed = _performed(packed.unpack(), task)
    after = packed if performed.report is None else PackedState.of(performed.state, packed)
    after = after.without_plan() if after.plan is packed.plan else after
    text = "" if performed.report is None else performed.report.document.to_json()  # the daemon has less time for it
    return WorkerResult(
        task.index, performed.window, after, performed.report, performed.seconds, performed.failure, text
    )


def _performed(state: AdaptationState, task: Task) -> Performed:
    """Cut the window of a task and adapt to it; samples that cannot be cut cost this window only."""
    from otolith.acquisition.cutting import cut  # noqa: PLC0415 - see the module's docstring

    try:
        window = cut(task.raw).window
        absent = absent_sources(task.link, window, {output.name for output in state.problem.twin.outputs})
    except Exception as error:
        log.exception("window %d", task.index)
        return Performed(None, state, None, 0.0, f"{type(error).__name__}: {error}")
    return perform(state, replace(window, absent=absent, outages=task.outages))


def perform(state: AdaptationState, window: Window) -> Performed:
    """Adapt to a window; an exception costs this window only."""
    from otolith.adaptation.adapt import adapt  # noqa: PLC0415 - see the module's docstring

    begun = time.perf_counter()
    report, failure = None, ""
    try:
        state, report = adapt(state, window)
    except Exception as error:  # any fault of the core: reported with the window, and the state stays as it was
        log.exception("window %d", window.index)
        failure = f"{type(error).__name__}: {error}"
    return Performed(window, state, report, time.perf_counter() - begun, failure)


def warm_up(state: AdaptationState) -> str:
    """Import and compile what the first window needs: no twin explains random values, so discovery runs as well.

    Returns the reason of a failure, or an empty string.
    """
    signals = state.problem.twin.signals
    values = np.random.default_rng(state.problem.seed).standard_normal((WARM_UP_RECORDS, len(signals)))
    window = Window.whole(0, 0.0, 0.01, signals, values)
    short = replace(state.problem, swarm=replace(state.problem.swarm, generations=2))
    return perform(with_problem(state, short), window).failure
