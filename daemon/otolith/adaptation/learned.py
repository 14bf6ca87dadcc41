"""What was learned of noise, and the sentences that go with it. Plain."""

from dataclasses import dataclass

import numpy as np

from otolith.adaptation.likelihood import noisy
from otolith.adaptation.problem import Problem

AS_IT_WAS = "; it stays as it was"
NEVER_MEASURED = "no window has a sample of it" + AS_IT_WAS
CONSTANT = "it never changes, so its noise is not to be seen" + AS_IT_WAS
AT_MOST = "no more than that: beside the process noise a better sensor would not be noticed"
UNSEEN = "no output shows it"
AT_REST = "nothing moves in these windows, and what strays in the machine when it runs is not to be seen"
NONE_NEEDED = "the windows are as likely without; about {:.1g} {} per square root of a second could hide"
NO_WINDOW = "no window can be used: nothing was learned"
LEFT_OUT = "windows left out because they are badly sampled, too short or beyond the twin: {} of {}"
RESTING = "windows left out because nothing moves in them: {} of {}"
ALONE = "one window cannot say whether windows agree"
NOTHING_SHARED = "no two windows see the same, so whether they agree is not to be seen"
BY_CHANCE = "windows agree as well as they claim"
INFLATED = "windows scatter more than they claim: process noise was inflated until they agree"
FROM_NOTHING = (
    "windows scatter more than they claim, though none shows process noise by itself: what is measured or driven got as"
    " much of it as makes them agree"
)
HELPLESS = (
    "windows scatter more than they claim, and no process noise makes them agree: it stays as the likelihood says"
)
DOUBTFUL = "; so much is hardly noise: the machine changes from window to window, or the twin lacks something"


@dataclass(frozen=True, slots=True)
class Level:
    """The noise of one output, or the process noise of one state."""

    name: str
    value: float
    """Standard deviation in the unit of the output; of a state, in its unit per square root of a second."""
    sd: float | None
    """Standard deviation of the value; none where it was not learned."""
    remark: str
    """In words, why it was not learned or what to know of it; empty if there is nothing to say."""


@dataclass(frozen=True, slots=True)
class Consistency:
    """What windows say of each other, with the likelihood's levels and with those that are handed out."""

    degrees: int
    """How many numbers were compared."""
    before: float | None
    """Reduced chi-square between windows; none where nothing can be compared."""
    after: float | None
    factor: float | None
    """On process noise; none where there was none to inflate."""
    remark: str


@dataclass(frozen=True, slots=True)
class LearnedNoise:
    """Levels of noise and how well they are known."""

    outputs: tuple[Level, ...]
    states: tuple[Level, ...]
    log_likelihood: float | None
    """Before inflation, restricted, up to a constant; none where nothing was learned."""
    consistency: Consistency
    windows: int
    """How many it was learned from."""
    remarks: tuple[str, ...]
    """What else there is to say of the windows."""
    evaluations: int

    def applied(self, problem: Problem) -> Problem:
        """The problem with these levels."""
        return noisy(problem, np.array([entry.value for entry in (*self.outputs, *self.states)]))


def nothing_learned(problem: Problem, remarks: tuple[str, ...]) -> LearnedNoise:
    """The levels of the problem, as they were."""
    twin = problem.twin
    strays = problem.process_noise or (0.0,) * len(twin.states)
    sensors = zip(twin.outputs, problem.noise, strict=True)
    states = zip(twin.states, strays, strict=True)
    return LearnedNoise(
        outputs=tuple(Level(entry.name, level, None, NO_WINDOW) for entry, level in sensors),
        states=tuple(Level(entry.name, level, None, NO_WINDOW) for entry, level in states),
        log_likelihood=None,
        consistency=Consistency(0, None, None, None, NO_WINDOW),
        windows=0,
        remarks=remarks,
        evaluations=0,
    )
