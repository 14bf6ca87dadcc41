"""Watches over the order of bytes: what reads like a swapped one is withheld, so that nobody estimates from it."""

from collections import deque
from collections.abc import Sequence
from itertools import cycle

from otolith_drivers.modbus_options import Item
from otolith_drivers.modbus_plausible import Judgement, judge

READINGS = 20  # of each number, that a judgement looks at
AGAIN = 100  # rounds, after which a number is judged anew
MOST_PATIENCE = 3 * READINGS  # rounds; what some registers never answer must not hold up the others


class OrderWatch:
    """Over all numbers that take more than one register; each is judged again from time to time, one in a round."""

    def __init__(self, items: Sequence[Item]) -> None:
        self._items = {item.name: item for item in items if item.count > 1}
        self._history: dict[str, deque[Sequence[int]]] = {name: deque(maxlen=READINGS) for name in self._items}
        self._judgements: dict[str, Judgement] = {}
        self.withheld: frozenset[str] = frozenset()
        """Signals whose readings are not to be believed now."""
        self._turn = cycle(self._items or [""])
        self._rounds = 0

    @property
    def ready(self) -> bool:
        """Whether all were judged once, or will not be soon."""
        return len(self._judgements) == len(self._items) or self._rounds > MOST_PATIENCE

    def take(self, item: Item, registers: Sequence[int]) -> None:
        """A reading."""
        history = self._history.get(item.name)
        if history is not None:
            history.append(registers)

    def end_round(self) -> None:
        """Judge what is due."""
        self._rounds += 1
        if not self.ready:
            names = list(self._items)
        elif self._rounds % max(1, AGAIN // max(1, len(self._items))) == 0:
            names = [next(self._turn)]
        else:
            return
        for each in names:
            if len(self._history.get(each, ())) == READINGS:
                item = self._items[each]
                self._judgements[each] = judge(self._history[each], item.kind, item.order)
        self.withheld = frozenset(name for name, found in self._judgements.items() if not found.plausible)

    def complaints(self) -> list[str]:
        """What is withheld and why, a line each."""
        lines = []
        for name, judgement in list(self._judgements.items()):
            if not judgement.plausible:
                item = self._items[name]
                way_out = (
                    f'as {judgement.better} it would be plausible: set order = "{judgement.better}"'
                    if judgement.better
                    else "no order of its bytes makes it plausible: is register or type wrong?"
                )
                lines.append(f"{name} ({item.describe()}) is withheld: {judgement.reason}; {way_out}")
        return lines
