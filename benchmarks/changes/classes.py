"""Changes that the data cannot distinguish, and the same changes where they can.

Each pair has two changes that give the same signals. A run is right if no window after the change states a verdict, and
the last one states the class: hypotheses of both changes, one of them the most probable. They have the same
probability, or the decision is ``AMBIGUOUS``. Where the data can distinguish, the right verdict must come within five
windows.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.changes.machines import DC_MOTOR, FLAT_PUMP, LAB_MOTOR, ONE_MASS, PUMP, REVERSING_MOTOR
from benchmarks.changes.observe import Case, Coverage, Observed, Stated, coverage
from benchmarks.changes.plants import Change, Plant, Term
from otolith.discovery.alternatives import WindowDecision

EQUAL = 0.01  # difference of two probabilities that count as the same
VERDICT_WINDOWS = 5  # after the change
NAMED_AT_LEAST, RIGHT_AT_LEAST = 0.99, 0.95
COVERED_AT_LEAST = 0.93
VERDICTS = frozenset({
    *(WindowDecision.STEPPED, WindowDecision.DISCOVERED, WindowDecision.FADED),
    *(WindowDecision.SENSOR, WindowDecision.TIMING),
})  # fmt: skip


@dataclass(frozen=True, slots=True)
class Member:
    """How a report states a change."""

    reason: str
    """Name of a type of hypothesis."""
    pattern: str = ""
    """Of the text of the hypothesis, or of the key of an adopted component."""

    def states(self, stated: Stated) -> bool:
        """Whether the hypothesis is this change."""
        return stated.reason == self.reason and re.search(self.pattern, stated.text) is not None

    def decides(self, window: Observed) -> bool:
        """Whether the decision of the window is this change."""
        if self.reason == "PARAMETER":
            return window.decision is WindowDecision.STEPPED
        if self.reason == "COMPONENT":
            adopted = any(re.search(self.pattern, item.text) for item in window.components)
            return window.decision is WindowDecision.DISCOVERED and adopted
        return window.decision is WindowDecision.SENSOR and any(map(self.states, most_probable(window)))


def most_probable(window: Observed) -> list[Stated]:
    """Return the hypotheses of the window than which none is more probable."""
    highest = max((item.probability for item in window.stated), default=0.0)
    return [item for item in window.stated if item.probability >= highest - EQUAL]


def _moved(*names: str) -> Member:
    """Return the change of these parameters, and perhaps of others."""
    return Member("PARAMETER", "".join(rf"(?=.*\b{name}\b)" for name in names))


@dataclass(frozen=True, slots=True)
class Trial:
    """One change of one machine, and what the reports should state."""

    pair: str
    truth: str
    case: Case
    members: tuple[Member, ...]
    """The class; one member if the data can distinguish it."""
    agreed: tuple[str, ...] = ()
    """Parameters that have the same value under all members."""

    @property
    def is_class(self) -> bool:
        """Whether the data cannot distinguish the members."""
        return len(self.members) > 1


def trials(healthy: int, changed: int) -> list[Trial]:
    """Return all trials with so many windows before and after the change."""
    return [replace(trial, case=replace(trial.case, healthy=healthy, changed=changed)) for trial in _trials()]


def _trial(
    pair: str,
    truth: str,
    plant: Plant,
    change: Change,
    members: Sequence[Member],
    free: tuple[str, ...] = (),
    agreed: tuple[str, ...] = (),
    **more: Any,
) -> Trial:
    return Trial(pair, truth, Case(f"{pair}: {truth}", plant, change, free, **more), tuple(members), agreed)


def _trials() -> list[Trial]:
    return [*_pump(), *_load(), *_speed(), *_brushes(), *_current(), *_inertia()]


def _pump() -> list[Trial]:
    pair, free, agreed = "k_v / gain of u", ("h_0", "h_2", "T_c", "k_v"), ("h_0", "h_2", "T_c")
    members = (_moved("k_v"), Member("SENSOR", r"^u reads .*%"))
    k_v = PUMP.parameters["k_v"]
    head, constant = "h_0 / constant head", (_moved("h_0"), Member("COMPONENT", "^head(:|/constant)"))
    step = Change(parameters={"h_0": 0.88 * PUMP.parameters["h_0"]})
    share = Change(terms={"head": Term("constant", amplitude=-0.12)})
    known = ("h_0", "T_c", "k_v")
    return [
        _trial(pair, "k_v +20 %", PUMP, Change(parameters={"k_v": 1.2 * k_v}), members, free, agreed),
        _trial(pair, "u reads 10 % more", PUMP, Change(gains={"u": math.sqrt(1.2)}), members, free, agreed),
        _trial(head, "h_0 -12 %", FLAT_PUMP, step, constant, known, ("T_c", "k_v")),
        _trial(head, "head -12 %", FLAT_PUMP, share, constant, known, ("T_c", "k_v")),
        _trial(head, "h_0 -12 %, curved", PUMP, step, constant[:1], known),
        _trial(head, "head -12 %, curved", PUMP, share, constant[1:], known),
    ]


def _load() -> list[Trial]:
    pair, free = "constant torque / offset of T_load", ("R_a", "D")
    members = (Member("COMPONENT", "^shaft(:|/constant)"), Member("SENSOR", r"^T_load reads .*N·m"))
    torque = Change(terms={"shaft": Term("constant", amplitude=-0.006)})
    offset = Change(offsets={"T_load": -0.006})
    return [
        _trial(pair, "torque -6 mN*m", DC_MOTOR, torque, members, free, free),
        _trial(pair, "T_load reads -6 mN*m", DC_MOTOR, offset, members, free, free),
        _trial(pair, "torque, reversing", REVERSING_MOTOR, torque, members, free, free),
    ]


def _speed() -> list[Trial]:
    pair, free = "K, J, T_c / gain of omega", ("K", "J", "T_c")
    members = (_moved("K", "J", "T_c"), Member("SENSOR", r"^omega reads .*%"))
    old, gain = LAB_MOTOR.parameters, 1.15
    values = {"K": old["K"] / gain, "J": old["J"] / gain**2, "T_c": old["T_c"] / gain}
    reads = Change(gains={"omega": gain})
    return [
        _trial(pair, "K, J and T_c", LAB_MOTOR, Change(parameters=values), members, free),
        _trial(pair, "omega reads 15 % more", LAB_MOTOR, reads, members, free),
        _trial(pair, "gain, current measured", DC_MOTOR, reads, members[1:], ("R_a", "D", "J")),
        _trial(pair, "J alone +20 %", LAB_MOTOR, Change(parameters={"J": 1.2 * old["J"]}), [_moved("J")], free),
    ]


def _brushes() -> list[Trial]:
    pair, free = "brush drop / offset of V_a", ("R_a", "D")
    offset_member = Member("SENSOR", r"^V_a reads wrong by .* V")
    members = (Member("COMPONENT", "^winding(:|/constant|/Coulomb)"), offset_member)
    drop = Change(terms={"winding": Term("Coulomb", "i", -0.6, 0.02)})
    offset = Change(offsets={"V_a": 0.6})
    coulomb = (Member("COMPONENT", r"^winding(: .*sign\(i\)|/Coulomb/i)"),)
    return [
        _trial(pair, "brushes 0.6 V", DC_MOTOR, drop, members, free, free),
        _trial(pair, "V_a reads 0.6 V more", DC_MOTOR, offset, members, free, free),
        _trial(pair, "brushes, reversing", REVERSING_MOTOR, drop, coulomb, free),
        _trial(pair, "offset, reversing", REVERSING_MOTOR, offset, members, free, free),
    ]


def _current() -> list[Trial]:
    pair, free, gain = "R_a, L_a, K_t / gain of i", ("R_a", "L_a", "K_t", "D"), 1.12
    members = (_moved("R_a", "L_a", "K_t"), Member("SENSOR", r"^i reads .*%"))
    old = DC_MOTOR.parameters
    moved = Change(parameters={name: old[name] / gain for name in ("R_a", "L_a", "K_t")})
    reads = Change(gains={"i": gain})
    return [
        _trial(pair, "R_a, L_a and K_t", DC_MOTOR, moved, members, free, ("D",)),
        _trial(pair, "i reads 12 % more", DC_MOTOR, reads, members, free, ("D",)),
        _trial(pair, "gain, L_a known", DC_MOTOR, reads, members[1:], ("R_a", "K_t", "D")),
        _trial(pair, "R_a alone +20 %", DC_MOTOR, Change(parameters={"R_a": 1.2 * old["R_a"]}), [_moved("R_a")], free),
    ]


def _inertia() -> list[Trial]:
    pair, free = "J / gain of omega", ("J", "T_c")
    members = (_moved("J"), Member("SENSOR", r"^omega reads .*%"))
    step = {"J": 0.8 * ONE_MASS.parameters["J"]}
    damped = replace(ONE_MASS, name="one_mass, damped", parameters={**ONE_MASS.parameters, "D": 0.02})
    reads = Change(gains={"omega": 1.25})
    return [
        _trial(pair, "J -20 %", ONE_MASS, Change(parameters=step), members, free, ("T_c",)),
        _trial(pair, "omega reads 25 % more", ONE_MASS, reads, members, free, ("T_c",)),
        _trial(pair, "J -20 %, damped", damped, Change(parameters=step), members[:1], free),
        _trial(pair, "gain, damped", damped, reads, members[1:], free),
    ]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the reports of one run stated after the change."""

    right: bool
    verdict: str
    """The first one, or nothing."""
    first: int | None
    """Windows until the class was stated, or until the right verdict."""
    equal: float
    """Share of the windows that state the class in which all members have the same probability."""
    last: str
    """Decision and hypotheses of the last window."""
    verdict_text: str
    """The same of the window with the first verdict."""


def judge(trial: Trial, run: Sequence[Observed]) -> Outcome:
    """Compare the reports of a run with what they should state."""
    after = run[trial.case.healthy :]
    verdict = next((window for window in after if window.decision in VERDICTS), None)
    named = [trial.is_class and states_class(trial, window) for window in after]
    equal = [has_equal_members(trial, window) for window, own in zip(after, named, strict=True) if own]
    if trial.is_class:
        first = next((number for number, own in enumerate(named, 1) if own), None)
        right = verdict is None and bool(named[-1])
    else:
        decided = [trial.members[0].decides(window) for window in after]
        first = next((number for number, own in enumerate(decided, 1) if own), None)
        wrong = verdict is not None and not trial.members[0].decides(verdict)
        right = first is not None and first <= VERDICT_WINDOWS and not wrong
    return Outcome(
        right=right,
        verdict="" if verdict is None else verdict.decision.name,
        first=first,
        equal=sum(equal) / len(equal) if equal else math.nan,
        last=text_of(after[-1]),
        verdict_text="" if verdict is None else f"window {after.index(verdict) + 1}: {text_of(verdict)}",
    )


def states_class(trial: Trial, window: Observed) -> bool:
    """Whether the window states all members, one of them first, as equally probable or as ambiguous."""
    complete = min(_shares(trial, window)) > 0.0
    leads = any(member.states(item) for item in most_probable(window) for member in trial.members)
    undecided = window.decision is WindowDecision.AMBIGUOUS or has_equal_members(trial, window)
    return complete and leads and undecided


def has_equal_members(trial: Trial, window: Observed) -> bool:
    """Whether each member is among the hypotheses of the window, all equally probable."""
    shares = _shares(trial, window)
    return min(shares) > 0.0 and max(shares) - min(shares) <= EQUAL


def _shares(trial: Trial, window: Observed) -> list[float]:
    """Return the probability that the window states of each member."""
    return [sum(item.probability for item in window.stated if member.states(item)) for member in trial.members]


def text_of(window: Observed) -> str:
    """Return decision and hypotheses as text."""
    stated = "; ".join(f"{item.reason} {item.text[:70]} ({item.probability:.3f})" for item in window.stated[:5])
    components = ", ".join(f"{item.text} ({item.probability:.3f})" for item in window.components)
    return f"{window.decision.name}: {stated}" + (f" | in the twin: {components}" if components else "")


@dataclass(frozen=True, slots=True)
class Summary:
    """The figures of one trial."""

    trial: Trial
    outcomes: tuple[Outcome, ...]
    coverage: Mapping[str, Coverage]
    """Of each parameter on which the members agree, after the change."""
    statuses: Mapping[str, Mapping[str, int]]
    """Of each estimated parameter after the change."""

    @property
    def right(self) -> float:
        """Share of the runs."""
        return sum(outcome.right for outcome in self.outcomes) / len(self.outcomes)

    @property
    def met(self) -> bool:
        """Whether the trial meets its targets; a coverage may miss its own by chance."""
        return self.right >= (NAMED_AT_LEAST if self.trial.is_class else RIGHT_AT_LEAST) and self.covers

    @property
    def covers(self) -> bool:
        """Whether the intervals hold the truth as often as they state; they may be wider."""
        return all(own.reaches(COVERED_AT_LEAST) for own in self.coverage.values())


def summarise(trial: Trial, runs: Sequence[Sequence[Observed]]) -> Summary:
    """Return the figures of the runs of a trial."""
    after = [window for run in runs for window in run[trial.case.healthy :]]
    return Summary(
        trial=trial,
        outcomes=tuple(judge(trial, run) for run in runs),
        coverage={name: coverage([window.parameters[name] for window in after]) for name in trial.agreed},
        statuses={name: Counter(window.parameters[name].status for window in after) for name in runs[0][0].parameters},
    )


def document(summary: Summary) -> dict[str, Any]:
    """Return the figures as a document."""
    trial = summary.trial
    firsts = sorted(own.first for own in summary.outcomes if own.first is not None)
    return {
        "pair": trial.pair,
        "truth": trial.truth,
        "expected": "class" if trial.is_class else trial.members[0].reason,
        "right": summary.right,
        "met": summary.met,
        "verdicts": dict(Counter(own.verdict for own in summary.outcomes)),
        "first": firsts[len(firsts) // 2] if firsts else None,
        "equal": _mean([own.equal for own in summary.outcomes]),
        "coverage": {name: own.held for name, own in summary.coverage.items()},
        "statuses": {name: dict(counts) for name, counts in summary.statuses.items()},
        "wrong": [
            {"run": number, "verdict": own.verdict_text, "last": own.last}
            for number, own in enumerate(summary.outcomes)
            if not own.right
        ],
    }


def _mean(values: Sequence[float]) -> float | None:
    finite = [value for value in values if not math.isnan(value)]
    return sum(finite) / len(finite) if finite else None
