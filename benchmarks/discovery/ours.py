"""The search on a typical case."""

from dataclasses import replace

import numpy as np

from benchmarks.discovery.motor import SIGNALS, windows
from benchmarks.discovery.setting import prior, problem, ranked
from benchmarks.discovery.truth import SHAFT, WINDING, Truth, same
from benchmarks.discovery.typical import Answer, Recorded, Typical, error_of
from otolith.discovery.hypotheses import FaultType, FittedHypothesis
from otolith.estimation.augmented import indices

SENSORS = {"sensor of T_load": (SHAFT, 1.0), "sensor of V_a": (WINDING, -1.0)}  # what an error adds to the machine


def answers(case: Typical, seen: Recorded, seed: int) -> dict[str, Answer]:
    """One answer: the best explanation by its evidence."""
    noise = dict(zip(SIGNALS, map(float, seen.noise), strict=True))
    own = problem()
    asked = replace(
        own,
        noise=tuple(noise[entry.name] for entry in own.twin.outputs),
        input_noise=tuple(noise[entry.name] for entry in own.twin.inputs),
    )
    best = ranked(asked, windows(seen.told)[0], prior(np.random.default_rng([seed, 2]))).explanations[0]
    return {"Otolith": _answer(case, seen, best)}


def _answer(case: Typical, seen: Recorded, best: FittedHypothesis) -> Answer:
    if case.truth is None:
        return Answer(best.reason in {FaultType.NOTHING, FaultType.PARAMETER}, np.nan, len(best.problem.components))
    keys = [entry.key for entry in best.problem.components]
    alike = same(case.truth)
    right = [place for place, key in enumerate(keys) if key in alike]
    if len(right) != 1:
        return Answer(False, np.nan, len(keys))
    component = best.problem.components[right[0]]
    values = [float(best.fit.guess[place]) for place in indices(best.problem, right[0])] + [0.0, 0.0]
    site, way = SENSORS.get(component.site, (component.site, 1.0))
    found = Truth(site, component.family, component.source, way * values[0], values[1], values[2])
    return Answer(len(keys) == 1, error_of(seen.effect(found), seen.effect(case.truth)), len(keys) - 1)
