"""Whether registers read in a certain order make a number that a machine could have. Pure.

A wrong order turns the fine steps of a signal into its coarse ones. Floating-point numbers then change their exponent
from reading to reading, or have one that no machine knows; integers jump over their whole range.

Watches over the order of bytes: what reads like a swapped one is withheld, so that nobody estimates from it.

Whether registers were renewed since they were last read: an old image under a new time would be a lie. Pure.

Registers with noise in them never say the same twice; where they do so now and then, the device was late. Where they do
so often, they are coarse, the machine stands still, or the device renews them more slowly than they are read. Registers
that move by a few steps only may repeat by chance; an old image of them is off by no more than these steps. One image
that comes twice is the beat of two clocks that are equally fast: it is off by less than a period, and is let pass.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.modbus.options import Item
from otolith_drivers.modbus.protocol import Order, TypeName, is_float, orders_of, reader, registers_of
from otolith_drivers.modbus.schedule import Request

Array = NDArray[np.float64]

FEWEST = 8  # readings that a judgement needs
DECADES = 6.0  # over which the middle half of a signal's numbers may spread
JUMP, OFTEN_IMPLAUSIBLE = 3.0, 0.25  # decades from reading to reading; share of readings
LEVELS = 3  # between which a signal may jump over decades, as set-points do
MUCH = 1e3  # times the usual size
SMALLEST, LARGEST = 1e-12, 1e12  # magnitudes in any unit that people use
COARSE_CHANGE = 1e-3  # of its whole range, by which an integer changes from reading to reading when bytes are swapped
BYTE = 256
FEWEST_STEPS = 4  # between different numbers, before their size says anything
OFTEN_CHANGED = 0.6  # share of readings, from which on a few numbers are no levels of a set-point
TIMES = 30.0  # how much calmer another order must be


@dataclass(frozen=True, slots=True)
class Judgement:
    """On the order of a number's bytes."""

    plausible: bool
    reason: str = ""
    better: Order | None = None
    """An order in which the numbers are plausible, where these are not."""


def judge(history: Sequence[Sequence[int]], kind: TypeName, order: Order, usual: float = 0.0) -> Judgement:
    """Of the registers of one number, read again and again; what is not enough to judge counts as plausible.

    ``usual`` is the size that the number had while it was plausible, 0 if it never was: a filter of a machine at rest
    ends in numbers that are as good as zero, and only another order that makes the usual ones of them is better.
    """
    if len(history) < FEWEST:
        return Judgement(plausible=True)
    orders = orders_of(kind)
    chosen = _among(orders, order)
    if is_float(kind) and not fault_of_floats(_numbers(history, kind, chosen)):  # seldom is more than this needed
        return Judgement(plausible=True)
    numbers = {other: _numbers(history, kind, other) for other in orders}
    reason = _fault(numbers, kind, chosen)
    if not reason:
        return Judgement(plausible=True)
    others = [other for other in orders if other != chosen and not _fault(numbers, kind, other)]
    if usual and is_float(kind) and _size(numbers[chosen]) < SMALLEST:
        others = [other for other in others if usual / MUCH < _size(numbers[other]) < usual * MUCH]
        if not others:
            return Judgement(plausible=True)
    better = min(others, key=lambda other: _roughness(numbers[other]), default=None)
    return Judgement(plausible=False, reason=reason, better=better)


def usual_size(history: Sequence[Sequence[int]], kind: TypeName, order: Order) -> float:
    """Of the numbers; 0 where they are all too small to tell."""
    size = _size(_numbers(history, kind, order))
    return size if size >= SMALLEST else 0.0


def _among(orders: tuple[Order, ...], order: Order) -> Order:
    return order if order in orders else orders[0 if order in ("ABCD", "CDAB") else 1]


def _size(numbers: Array) -> float:
    sizes = np.abs(numbers[np.isfinite(numbers) & (numbers != 0.0)])
    return float(np.median(sizes)) if len(sizes) else 0.0


def _numbers(history: Sequence[Sequence[int]], kind: TypeName, order: Order) -> Array:
    read = reader(kind, order)
    return np.array([read(registers[: registers_of(kind)]) for registers in history], dtype=np.float64)


def _fault(numbers: dict[Order, Array], kind: TypeName, order: Order) -> str:
    """What is wrong with the numbers in this order; nothing if they will do."""
    return fault_of_floats(numbers[order]) if is_float(kind) else _fault_of_integers(numbers, kind, order)


def fault_of_floats(numbers: Array) -> str:
    """What is wrong with ``numbers`` as readings of a machine, in words; nothing if they will do.

    Those that are no numbers are how a device says that it has no reading; such a reading is none in any order.
    """
    finite = numbers[np.isfinite(numbers)]
    if not len(finite):
        return "none of the readings is a number"
    sizes = np.abs(finite[finite != 0.0])
    if not len(sizes):
        return ""
    middle = float(np.median(sizes))
    if not SMALLEST <= middle <= LARGEST:
        return f"it reads {middle:.3g}, which no machine has"
    return _wild(np.log10(sizes))


def _wild(logs: Array) -> str:
    """Whether numbers are scattered over decades, and that again and again: a set-point jumps between a few levels."""
    low, high = np.quantile(logs, (0.25, 0.75))
    if high - low <= DECADES or np.mean(np.abs(np.diff(logs)) > JUMP) < OFTEN_IMPLAUSIBLE:
        return ""
    apart = np.sort(np.diff(np.sort(logs)[len(logs) // 10 : len(logs) - len(logs) // 10]))
    return f"it jumps over {high - low:.0f} decades" if apart[: 1 - LEVELS].sum() > DECADES else ""


def _fault_of_integers(numbers: dict[Order, Array], kind: TypeName, order: Order) -> str:
    whole = 2.0 ** (16 * registers_of(kind))
    jumps = {other: _jump(found, whole) for other, found in numbers.items()}
    calmest = min(jumps.values())
    steps = np.diff(np.unique(numbers[order]))
    held = len(steps) < FEWEST_STEPS and np.mean(np.diff(numbers[order]) != 0.0) < OFTEN_CHANGED  # as set-points are
    if not held and jumps[order] > COARSE_CHANGE * whole and jumps[order] > TIMES * calmest:
        return f"it jumps by {jumps[order] / whole:.1%} of its whole range from reading to reading"
    if len(steps) >= FEWEST_STEPS and jumps[order] > calmest and not np.any(np.fmod(steps, BYTE)):
        return f"it only ever changes by multiples of {BYTE}"
    return ""


def _jump(numbers: Array, whole: float) -> float:
    """The mean one from reading to reading, the shorter way round: a counter that wraps does not jump."""
    jumps = np.abs(np.diff(numbers))
    return float(np.mean(np.minimum(jumps, whole - jumps)))


def _roughness(numbers: Array) -> float:
    """How much numbers change from reading to reading, as a share of their size."""
    size = float(np.mean(np.abs(numbers)))
    return float(np.mean(np.abs(np.diff(numbers)))) / size if size else 0.0


READINGS = 20  # of each number, that a judgement looks at
AGAIN = 100  # rounds, after which a number is judged anew


class OrderWatch:
    """Over all numbers that take more than one register; each is judged again from time to time, one in a round."""

    def __init__(self, items: Sequence[Item]) -> None:
        self._items = {item.name: item for item in items if item.count > 1 and not item.source.trusted}
        self._history: dict[str, deque[Sequence[int]]] = {name: deque(maxlen=READINGS) for name in self._items}
        self._judgements: dict[str, Judgement] = {}
        self._usual: dict[str, float] = {}
        self.withheld: frozenset[str] = frozenset()
        """Signals whose readings are not to be believed now."""
        self._turn = cycle(self._items or [""])
        self._rounds = 0

    def unjudged(self, name: str) -> bool:
        """Whether a number waits for its first judgement; each does for itself, whenever its device answers."""
        return name in self._items and name not in self._judgements

    def take(self, item: Item, registers: Sequence[int]) -> None:
        """A reading."""
        history = self._history.get(item.name)
        if history is not None:
            history.append(registers)

    def end_round(self) -> None:
        """Judge what is due: what never was, one of what is withheld, and from time to time one of all."""
        self._rounds += 1
        due = {name for name in self._items if name not in self._judgements}
        if self.withheld:
            due.add(sorted(self.withheld)[self._rounds % len(self.withheld)])
        if self._rounds % max(1, AGAIN // max(1, len(self._items))) == 0:
            due.add(next(self._turn))
        due = {name for name in due if len(self._history.get(name, ())) == READINGS}
        for name in due:
            self._judge(name)
        if due:
            self.withheld = frozenset(name for name, found in self._judgements.items() if not found.plausible)

    def _judge(self, name: str) -> None:
        item, history = self._items[name], self._history[name]
        found = judge(history, item.kind, item.order, self._usual.get(name, 0.0))
        self._judgements[name] = found
        if found.plausible and (size := usual_size(history, item.kind, item.order)) > 0.0:
            self._usual[name] = size

    def warnings(self) -> list[str]:
        """What is withheld and why, a line each."""
        lines = []
        for name, judgement in list(self._judgements.items()):
            if not judgement.plausible:
                item = self._items[name]
                way_out = (
                    f'as {judgement.better} it would be plausible: set order = "{judgement.better}", '
                    "unless register is one off"
                    if judgement.better
                    else "no order of its bytes makes it plausible: is register or type wrong?"
                )
                way_out += ", or say trusted = true"
                lines.append(f"{name} ({item.describe()}) is withheld: {judgement.reason}; {way_out}")
        return lines


SELDOM = 0.1  # share of readings that repeat the one before, below which one that does is old
OFTEN_STALE = 0.6  # share, above which the user should know
MEMORY = 0.01  # of a share: how much a reading counts
SETTLED = 200  # readings, before which a share says more of its beginning than of them
FEW_STEPS = 16  # of a register, from reading to reading
COARSE_SHARE = 0.5  # share of readings that move by so few, above which registers are coarse
MOST_IN_A_ROW = 100  # old images; what says the same for longer stands still


class StalenessMonitor:
    """Of all requests of a driver."""

    def __init__(self) -> None:
        self._images: dict[Request, Sequence[int]] = {}
        self._shares: dict[Request, float] = {}
        self._beats: dict[Request, float] = {}
        self._readings: dict[Request, int] = {}
        self._coarse: dict[Request, float] = {}
        self._in_a_row: dict[Request, int] = {}

    def take(self, request: Request, registers: Sequence[int]) -> tuple[bool, bool]:
        """Whether they repeat the ones before, and whether they are old because of that."""
        before = self._images.get(request)
        repeated = before == registers
        self._images[request] = registers
        share = self._shares.get(request, 1.0)  # until it has shown otherwise, a device may repeat itself
        self._shares[request] = share + MEMORY * (repeated - share)
        self._readings[request] = self._readings.get(request, 0) + 1
        coarse = self._coarse.get(request, 1.0)
        if before is not None and not repeated:
            self._coarse[request] = coarse + MEMORY * (_near(before, registers) - coarse)
        in_a_row = self._in_a_row[request] = self._in_a_row.get(request, 0) + 1 if repeated else 0
        beats = self._beats.get(request, 1.0)
        if in_a_row <= 1:  # a device that stops to renew its registers does so once, however long
            self._beats[request] = beats + MEMORY * (repeated - beats)
        return repeated, 1 < in_a_row <= MOST_IN_A_ROW and beats < SELDOM and coarse < COARSE_SHARE

    def warnings(self, requests: Sequence[Request], period: float) -> list[str]:
        """Which of ``requests`` say the same too often to be read every ``period`` s, a line each."""
        shares = {entry: self._shares[entry] for entry in requests if self._readings.get(entry, 0) >= SETTLED}
        return [
            f"{request.describe()} say the same in {share:.0%} of the readings: the machine stands still, or they are "
            f"renewed more slowly than every {period * 1e3:g} ms"
            for request, share in shares.items()
            if OFTEN_STALE < share < 1.0 - MEMORY
        ]


def _near(before: Sequence[int], after: Sequence[int]) -> bool:
    """Whether no register has moved by more than a few steps, the shorter way round."""
    steps = ((new - old) % 65536 for old, new in zip(before, after, strict=True))
    return all(step <= FEW_STEPS or step >= 65536 - FEW_STEPS for step in steps)
