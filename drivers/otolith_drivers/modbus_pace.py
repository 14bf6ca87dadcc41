"""When the next round of requests is due, and what rate is achieved. Pure: times (s) come in as arguments.

Rounds begin on a grid of absolute moments, so that a late one does not delay those after it. Where the line is slower
than asked, the grid is made as coarse as it takes: evenly spaced samples are worth more than many.
"""

import math
from collections import deque

ROUNDS = 50  # that a decision is based on
FULL = 0.95  # share of the period beyond which rounds leave no room for what delays them
ROOM = 1.15  # of a longer period over what rounds take
MOST_LEFT_OUT = 0.2  # share of the grid; less is a busy computer, and passes
MOST_AT_ONCE = 2  # left out before a round, that are laid to the line's speed; a timeout leaves out more
SLOW_IN_A_ROW = 2  # decisions by which a coarser grid is needed, before it is made
SLOW_FOR = 3.0  # s, for the same: a computer that is busy for a moment is no slow line
EASY = 20  # decisions in a row by which a finer grid would do, before it is tried again
STEPS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)  # times a power of ten: periods that people use
SELDOM, OFTEN = 0.02, 0.6  # shares of rounds that repeat the one before, between which the beat is heard
BEAT_ROUNDS = 100
QUARTERS = 4  # of the period: steps away from the beat
MOST_BEATS = 64  # hundreds of rounds between two steps away from the beat, where steps do not help


class Pace:
    """The grid of rounds."""

    def __init__(self, asked: float) -> None:
        self.asked = asked
        self.period = asked
        self.due = math.inf
        self._starts: deque[float] = deque(maxlen=ROUNDS + 1)
        self._durations: list[float] = []
        self._left_out = self._slow = self._easy = 0
        self._slow_for = 0.0
        self._repeats = self._rounds = 0
        self._beats = self._steps = 0
        self.known = False
        """Whether enough rounds were seen to know that the period can be held."""

    def start(self, now: float) -> None:
        """Lay the grid through ``now``."""
        self.due = now

    def begin(self, now: float) -> int:
        """A round begins; how many before it were left out since the last one."""
        behind = self._behind(now)
        self.due += (behind + 1) * self.period
        self._left_out += min(behind, MOST_AT_ONCE)
        self._starts.append(now)
        return behind

    def pass_over(self, now: float) -> int:
        """The line is away: how many rounds were due meanwhile; they are left out."""
        missed = self._behind(now) + 1 if now >= self.due else 0
        self.due += missed * self.period
        self._starts.clear()
        return missed

    def _behind(self, now: float) -> int:
        return max(0, math.floor((now - self.due) / self.period))

    def end(self, duration: float, *, repeated: bool) -> bool:
        """A round in which all answered took ``duration`` s; whether the grid was changed because of it.

        ``repeated``: every register had the value of the round before. Where that happens now and then, the device
        renews its registers as often as they are read, and at the same moment: reading then moves away from it.
        """
        self._durations.append(duration)
        self._rounds += 1
        self._repeats += repeated
        if self._rounds >= BEAT_ROUNDS:
            self._step_aside(heard=SELDOM <= self._repeats / self._rounds <= OFTEN)
            self._rounds = self._repeats = 0
        if len(self._durations) < ROUNDS:
            return False
        wanted = self._wanted()
        self._durations.clear()
        self._left_out, self.known = 0, self._slow == 0
        if wanted == self.period:
            return False
        self.due += wanted - self.period
        self.period = wanted
        self._starts.clear()
        return True

    def _step_aside(self, *, heard: bool) -> None:
        """Away from the beat; less and less often once all quarters were tried, as coarse registers sound like one."""
        self._beats += 1
        if not heard:
            self._steps = max(0, self._steps - 1)
        elif self._beats >= min(2 ** max(0, self._steps - QUARTERS), MOST_BEATS):
            self.due += self.period / QUARTERS
            self._beats, self._steps = 0, self._steps + 1

    def _wanted(self) -> float:
        """The period (s) that the last rounds speak for."""
        usual = sorted(self._durations)[ROUNDS // 2]
        share = self._left_out / (ROUNDS + self._left_out)
        if usual > FULL * self.period or share > MOST_LEFT_OUT:
            self._slow, self._easy = self._slow + 1, 0
            self._slow_for += ROUNDS * max(usual, self.period)
            if self._slow < SLOW_IN_A_ROW or self._slow_for < SLOW_FOR:
                return self.period
            self._slow_for = 0.0
            return _even(ROOM * usual if usual > FULL * self.period else self.period / (1.0 - share))
        self._slow, self._slow_for = 0, 0.0
        finer = max(self.asked, _even(ROOM * usual))
        self._easy = self._easy + 1 if finer < self.period else 0
        if self._easy < EASY:
            return self.period
        self._easy = 0
        return finer

    @property
    def achieved(self) -> float | None:
        """Seconds from round to round; None while too few have followed each other."""
        if len(self._starts) < ROUNDS // 2:
            return None
        return (self._starts[-1] - self._starts[0]) / (len(self._starts) - 1)

    def describe(self) -> str:
        """Asked and achieved, in words."""
        achieved = "achieved: not known yet" if self.achieved is None else f"{1 / self.achieved:.1f} achieved"
        coarser = f" (the grid is now {self.period * 1e3:g} ms)" if self.period > self.asked else ""
        return f"{1 / self.asked:g} Hz asked, {achieved}{coarser}"


def _even(period: float) -> float:
    """The next longer period (s) that people would write."""
    power = 10.0 ** math.floor(math.log10(period))
    return next(step * power for step in STEPS if step * power >= period * (1 - 1e-9))
