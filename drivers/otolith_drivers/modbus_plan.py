"""Which registers are read together: as few requests as the device's limits allow. Pure."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from otolith_drivers.modbus_options import Item, Table


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """Registers of one device that are read at once."""

    device: int
    table: Table
    address: int
    count: int
    items: tuple[Item, ...]
    """In the order of their addresses."""

    def describe(self) -> str:
        """In words."""
        last = self.address + self.count - 1
        return f"device {self.device}, {self.table} registers {self.address} to {last}"


def plan(items: Iterable[Item], max_gap: int, max_registers: int) -> tuple[Request, ...]:
    """Requests for all ``items``, each at most ``max_registers`` long and with gaps of at most ``max_gap`` in it."""
    requests: list[Request] = []
    together: list[Item] = []
    for item in sorted(items, key=lambda item: (item.device, item.table, item.address, item.end)):
        if together and not _fits(together, item, max_gap, max_registers):
            requests.append(_request(together))
            together = []
        together.append(item)
    return tuple([*requests, _request(together)] if together else requests)


def split(request: Request) -> tuple[Request, ...]:
    """The same items in two requests, apart where the gap between them is widest; itself if it cannot be split.

    A device that refuses a request may refuse only what nobody wants in it, or only one of its items.
    """
    items = request.items
    ends = [max(item.end for item in items[: at + 1]) for at in range(len(items))]
    gaps = [items[at].address - ends[at - 1] for at in range(1, len(items))]
    if not gaps or max(gaps) < 0:  # nothing to part, or only what overlaps
        return (request,)
    middle = len(items) / 2
    at = 1 + max(range(len(gaps)), key=lambda index: (gaps[index], -abs(index + 1 - middle)))
    return _request(items[:at]), _request(items[at:])


def summary(requests: Sequence[Request]) -> str:
    """How much is read."""
    registers = sum(request.count for request in requests)
    return f"{len(requests)} request{'s' * (len(requests) != 1)}, {registers} register{'s' * (registers != 1)}"


def _fits(together: Sequence[Item], item: Item, max_gap: int, max_registers: int) -> bool:
    first, end = together[0], max(other.end for other in together)
    return (
        (item.device, item.table) == (first.device, first.table)
        and item.address - end <= max_gap
        and max(end, item.end) - first.address <= max_registers
    )


def _request(items: Sequence[Item]) -> Request:
    first = items[0]
    end = max(item.end for item in items)
    return Request(first.device, first.table, first.address, end - first.address, tuple(items))
