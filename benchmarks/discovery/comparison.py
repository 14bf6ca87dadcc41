"""Otolith's search and PySINDy on the twelve typical cases, by sensor noise."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from rich.console import RenderableType
from rich.table import Table

from benchmarks.discovery import sindy
from benchmarks.discovery.motor import SIGNALS, windows
from benchmarks.discovery.setting import prior, problem, search_and_rank
from benchmarks.discovery.truth import SHAFT, WINDING, Truth, same
from benchmarks.discovery.typical import TYPICAL, Answer, Recorded, Typical, error_of, record
from otolith.discovery.hypotheses import FaultType, FittedHypothesis
from otolith.estimation.problem import indices

NOISES = (0.0, 0.01, 0.02, 0.05, 0.10)  # of each signal's standard deviation
SENSORS = {
    "sensor of T_load": (SHAFT, 1.0),
    "sensor of V_a": (WINDING, -1.0),
}  # effect of a sensor error on the machine
OURS = "Otolith"
Cell = tuple[int, float, int]  # index of the typical case, noise, seed


@dataclass(frozen=True, slots=True)
class CellResult:
    """The answers of all methods in one window."""

    case: int
    noise: float
    answers: dict[str, Answer]


def cells(repeats: int, seed: int) -> list[Cell]:
    """All windows."""
    return [(case, noise, seed + turn) for case in range(len(TYPICAL)) for noise in NOISES for turn in range(repeats)]


def run_cell(cell: Cell, *, with_sindy: bool) -> CellResult:
    """The answers of all methods."""
    number, noise, seed = cell
    case = TYPICAL[number]
    recorded = record(case, noise, seed)
    answers = {OURS: _otolith(case, recorded, seed)}
    if with_sindy:
        answers |= sindy.answers(case, recorded, seed)
    return CellResult(number, noise, answers)


def _otolith(case: Typical, recorded: Recorded, seed: int) -> Answer:
    """The best hypothesis by its evidence."""
    noise = dict(zip(SIGNALS, map(float, recorded.noise), strict=True))
    twin = problem().twin
    noisy = replace(
        problem(),
        noise=tuple(noise[output.name] for output in twin.outputs),
        input_noise=tuple(noise[signal.name] for signal in twin.inputs),
    )
    window, known = windows(recorded.measured)[0], prior(np.random.default_rng([seed, 2]))
    return _answer(case, recorded, search_and_rank(noisy, window, known).hypotheses[0])


def _answer(case: Typical, recorded: Recorded, best: FittedHypothesis) -> Answer:
    if case.truth is None:
        return Answer(best.type in {FaultType.NOTHING, FaultType.PARAMETER}, np.nan, len(best.problem.components))
    keys = [component.key for component in best.problem.components]
    equivalent = same(case.truth)
    right = [index for index, key in enumerate(keys) if key in equivalent]
    if len(right) != 1:
        return Answer(False, np.nan, len(keys))
    component = best.problem.components[right[0]]
    values = [float(best.fit.result.guess[index]) for index in indices(best.problem, right[0])] + [0.0, 0.0]
    site, sign = SENSORS.get(component.site, (component.site, 1.0))
    estimated = Truth(site, component.family, component.source, sign * values[0], values[1], values[2])
    return Answer(len(keys) == 1, error_of(recorded.effect(estimated), recorded.effect(case.truth)), len(keys) - 1)


def shown(results: Sequence[CellResult]) -> list[str]:
    """Otolith, and of every variant of PySINDy the setting that is best over all windows."""
    names = list(results[0].answers)

    def merit(name: str) -> tuple[int, int, int]:
        merits = [_merit(result.answers[name]) for result in results]
        exact, right, spurious = map(sum, zip(*merits, strict=True))
        return exact, right, spurious

    variants = {name.partition(" ")[0] for name in names if name != OURS}
    best = [max((n for n in names if n.partition(" ")[0] == variant), key=merit) for variant in sorted(variants)]
    return [OURS, *best]


def _merit(answer: Answer) -> tuple[bool, bool, int]:
    """Right without spurious terms, right, spurious terms: larger is better."""
    return answer.right and not answer.spurious, answer.right, -answer.spurious


def pages(results: Sequence[CellResult]) -> Iterator[RenderableType]:
    """Both tables."""
    names = shown(results)
    table = _table("right of all windows, median error of the effect, spurious terms per window", "case", "method")
    for number, case in enumerate(TYPICAL):
        for name in names:
            own = [[r.answers[name] for r in results if (r.case, r.noise) == (number, noise)] for noise in NOISES]
            title = case.name if name == names[0] else ""
            table.add_row(title, name, *map(_counts, own), end_section=name == names[-1])
    yield table
    whole = _table("right of all windows; without any spurious term; spurious terms per window", "method")
    for name in names:
        whole.add_row(name, *(_shares([r.answers[name] for r in results if r.noise == noise]) for noise in NOISES))
    for variant in sorted({name.partition(" ")[0] for name in names[1:]}):
        best = (_shares([_best(r, variant) for r in results if r.noise == noise]) for noise in NOISES)
        whole.add_row(f"{variant}, the best setting for each window", *best)
    yield whole


def _table(title: str, *columns: str) -> Table:
    table = Table(*columns, title=title)
    for noise in NOISES:
        table.add_column(f"{100 * noise:g} % noise", justify="right")
    return table


def _best(result: CellResult, variant: str) -> Answer:
    """The answer of the setting that is best for this window, chosen with the truth."""
    own = [answer for name, answer in result.answers.items() if name.partition(" ")[0] == variant]
    return max(own, key=_merit)


def _counts(answers: Sequence[Answer]) -> str:
    errors = [answer.error for answer in answers if not math.isnan(answer.error)]
    error = f"{100.0 * float(np.median(errors)):.2g} %" if errors else ""
    return f"{sum(answer.right for answer in answers)}/{len(answers)} {error:>7} +{_spurious(answers):.1f}"


def _shares(answers: Sequence[Answer]) -> str:
    right = sum(answer.right for answer in answers) / len(answers)
    exact = sum(answer.right and not answer.spurious for answer in answers) / len(answers)
    return f"{100 * right:.0f} %  {100 * exact:.0f} %  +{_spurious(answers):.1f}"


def _spurious(answers: Sequence[Answer]) -> float:
    """Per window."""
    return sum(answer.spurious for answer in answers) / len(answers)


def document(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """For ``--json``: the answers of all settings."""
    names = shown(results)
    return [
        {"case": TYPICAL[r.case].name, "noise": r.noise, "by": name, "shown": name in names} | asdict(answer)
        for r in results
        for name, answer in r.answers.items()
    ]
