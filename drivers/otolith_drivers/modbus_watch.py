"""Watches over the order of bytes: what reads like a swapped one is withheld, so that nobody estimates from it."""

from collections import deque
from collections.abc import Sequence
from itertools import cycle

from otolith_drivers.modbus_options import Item
from otolith_drivers.modbus_plausible import Judgement, judge, usual_size

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

    def complaints(self) -> list[str]:
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
