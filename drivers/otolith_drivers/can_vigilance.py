"""What tells that frames are missing or repeated: their pace and their counter. No clock in here."""

import re
import statistics

from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.can_fields import Field, field

LEARNED_FROM, LEARNED_OVER, MOST_INTERVALS = 8, 0.25, 4096  # intervals; s; intervals
MOSTLY = 0.75  # of the intervals of something regular are like the one in the middle
SOON, LATE = 0.5, 1.5  # of the period: what comes sooner was held up before, what comes later lacks a frame
FOLLOWING = 0.02  # of the difference, with each frame: periods of cheap oscillators drift
MOST_ODD = 32  # intervals in a row, after which the message has another period
LONGEST_OUTAGE = 60.0  # s; who is silent for longer has stopped to send, and nothing is known to be lost
SILENT_AFTER, SILENT_AT_LEAST = 10.0, 0.5  # periods; s
IRREGULAR_SILENT_AT_LEAST = 10.0  # s
PROOF = 8  # steps of one in a row, before a signal is believed to be a counter because of its name
STANDS_STILL = 3  # repeated frames

COUNTER_NAMES = re.compile(
    r"(?:^|[_a-z0-9])(?:(?:Alive|Rolling|Message|Msg|Sequence|Seq|Frame|Live)_?(?:Roll(?:ing)?_?)?(?:Counter|Count|Cntr|Cnt|Ctr|Cyc))$"
    r"|^(?:Alive|Rolling|Message|Msg|Sequence|Seq|Frame|Live)_?(?:Counter|Count|Cntr|Cnt|Ctr)$"
    r"|^(?:COUNTER|Counter|CNT|RC|ARC|SQC|Alive|ALIVE)$"
    r"|_(?:COUNTER|Counter|CNT|Cnt|CTR|BZ|ARC|RC|SQC|MC)$"
)
"""How vendors name the counter of a message; BZ is the German ``Botschaftszähler``."""
NOT_OF_MESSAGES = re.compile(
    r"err|fault|puls|encod|revol|rotat|turn|start|hour|time|step|edge|tooth|batch|piece|part|lost|fail|bus_?off",
    re.IGNORECASE,
)


class Pace:
    """How often something comes, learned from when it came, unless it is declared."""

    def __init__(self, declared: float | None = None) -> None:
        self.period = declared
        """s; None until it is known."""
        self.regular = declared is not None
        self.last: float | None = None
        self._declared = declared is not None
        self._intervals: list[float] = []
        self._odd = 0
        self._missing = 0
        self._held_up = 0

    def note(self, time: float) -> int:
        """One has come at ``time``; how many are now known to be missing before it.

        A gap counts once the next interval is a regular one: after a hold-up all come, in a burst.
        """
        last, self.last = self.last, time
        if last is None:
            return 0
        elapsed = time - last
        if self.period is None or not self.regular:
            self._learn(elapsed)
            return 0
        ratio = elapsed / self.period
        if SOON <= ratio <= LATE:
            self._follow(elapsed)
            missing, self._missing = self._missing, 0
            return missing
        if ratio < SOON and self._missing:
            self._missing -= 1
            return 0
        if self._oddity() or ratio < SOON:
            return 0
        missing, self._missing = self._missing, round(ratio) - 1 if elapsed < LONGEST_OUTAGE else 0
        return missing

    def counted(self, time: float, step: int, modulo: int) -> int:
        """The same for one that is counted ``step`` after the last, modulo ``modulo``: how many frames it is ahead.

        An outage may be longer than the counter's cycle: it is then the number nearest to what the clock says. Whole
        cycles count once the next interval is a regular one, with that one.
        """
        last, self.last = self.last, time
        if last is None:
            return 1
        elapsed = time - last
        if self.period is None or not self.regular:
            if step:
                self._learn(elapsed / step)
            return step
        if step == 1 and SOON <= elapsed / self.period <= LATE:  # as nearly always
            self._follow(elapsed)
            missing, self._missing = self._missing, 0
            return 1 + missing
        expected = elapsed / self.period if elapsed < LONGEST_OUTAGE else 0.0
        cycles = max(0, round((expected - step) / modulo))
        if cycles and not step:  # the count of the last frame, but not that frame
            step, cycles = modulo, cycles - 1
        if not step:
            return 0
        missing, self._missing = self._missing, cycles * modulo
        ratio = elapsed / self.period / (step + cycles * modulo)
        if SOON <= ratio <= LATE:
            self._follow(ratio * self.period)
            return step + missing
        if ratio > LATE:
            self._held_up = int(expected) - step
        elif self._held_up > 0:
            self._held_up -= step
            return step
        self._oddity()
        return step + missing if ratio > LATE else step

    def silent_for(self, now: float) -> float | None:
        """Seconds without one, where that is longer than it ever should be."""
        if self.last is None:
            return None
        least = SILENT_AT_LEAST if self.regular else IRREGULAR_SILENT_AT_LEAST
        silence = now - self.last
        return silence if silence > max(least, SILENT_AFTER * (self.period or 0.0)) else None

    def pace(self) -> str:
        """In words."""
        if self.period is None:
            return "at a pace that is not known"
        return f"every {period_text(self.period)}" + ("" if self.regular else " or so, not regularly")

    def _follow(self, interval: float) -> None:
        self._odd = 0
        if not self._declared and self.period is not None:
            self.period += FOLLOWING * (interval - self.period)

    def _oddity(self) -> bool:
        """Whether there were so many that the period is learned anew."""
        self._odd += 1
        if self._odd < MOST_ODD or self._declared:
            return False
        self.period, self.regular, self._odd, self._missing = None, False, 0, 0
        return True

    def _learn(self, interval: float) -> None:
        """By the mean of some time: in a burst that a hold-up has left, intervals are anything."""
        self._intervals.append(interval)
        count, span = len(self._intervals), sum(self._intervals)
        if count < LEARNED_FROM or (span < LEARNED_OVER and count < MOST_INTERVALS):
            return
        middle, mean = statistics.median(self._intervals), span / count
        inside = [entry for entry in self._intervals if SOON * middle <= entry <= LATE * middle]
        self.regular = len(inside) >= MOSTLY * count and middle > 0.0 and abs(mean / middle - 1.0) < LATE - 1.0
        self.period = statistics.fmean(inside) if self.regular else mean
        self._intervals.clear()


def period_text(period: float) -> str:
    """A period as people say it."""
    return f"{period * 1e3:.1f} ms" if period < 1.0 else f"{period:.1f} s"


class FrameCounter:
    """The counter in a message, declared or recognised by its name; the latter must first count to be believed."""

    def __init__(self, signal: CanSignal, modulo: int | None = None, *, declared: bool) -> None:
        """``modulo`` is one more than the highest count; without it that is the database's, or what the bits hold."""
        self.name = signal.name
        self.modulo = modulo or _modulo(signal)
        self.standing = 0
        """Frames since it last moved."""
        self._read: Field = field(signal)
        self.declared = declared
        self._trusted = declared
        self._run = 0
        self._last: int | None = None
        self._spoiled = 0

    def spoiled(self) -> None:
        """A frame came whose counter cannot be believed: it will be missing in the count, but it is not lost."""
        self._spoiled += 1

    def missing(self, data: bytes | bytearray, time: float, pace: Pace) -> int:
        """Frames lost before this one; -1 where it is the one before once more."""
        count = int(self._read(data)) % self.modulo
        last, self._last = self._last, count
        step = (count - last) % self.modulo if last is not None else 1
        if not self._trusted:
            self._run = self._run + 1 if step == 1 else 0
            self._trusted, self._spoiled = self._run > PROOF, 0
            return pace.note(time)
        before = pace.last
        ahead = pace.counted(time, step, self.modulo)
        if ahead == 0:
            pace.last = before  # time goes on from the last frame that was new
            self.standing += 1
            return -1
        spoiled, self._spoiled, self.standing = self._spoiled, 0, 0
        return max(0, ahead - 1 - spoiled)


def _modulo(signal: CanSignal) -> int:
    whole = 1 << signal.length
    highest = signal.maximum
    return int(highest) + 1 if highest is not None and 1.0 < highest < whole - 1 else whole


def counter_by_name(message: Message, taken: set[str]) -> CanSignal | None:
    """The signal of ``message`` that is called as counters are; none where several are, or where it is ``taken``."""
    found = [
        signal
        for signal in message.signals
        if COUNTER_NAMES.search(signal.name)
        and not NOT_OF_MESSAGES.search(signal.name)
        and signal.name not in taken
        and signal.multiplexer_signal is None
        and 2 <= signal.length <= 16
        and not signal.is_signed
        and not signal.conversion.is_float
        and (signal.conversion.scale, signal.conversion.offset) == (1, 0)
    ]
    return found[0] if len(found) == 1 else None
