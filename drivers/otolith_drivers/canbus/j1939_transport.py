"""The transport protocol of SAE J1939-21: messages of 9 to 1785 bytes in several frames, only listened to.

A node announces size and parameter group to all nodes (BAM), or to one that then controls the transfer (RTS, CTS), and
sends packets of 7 bytes. No clock in here: the time of a frame is an argument.
"""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import NamedTuple

from otolith_drivers.common.reconnection import PassingFault

MANAGEMENT, DATA = 0xEC00, 0xEB00  # the parameter groups of the protocol
RTS, CTS, END, BAM, ABORT = 16, 17, 19, 32, 255  # what a frame of connection management is, by its first byte
PACKET_BYTES, MIN_BYTES, MAX_BYTES = 7, 9, 1785
MAX_PAUSE = 1.25  # s between two frames of a transfer: the longest timeout of the standard (T2, T3)


NodePair = tuple[int, int]
"""Addresses of the node that sends a frame, and of that for which it is."""


class WholeMessage(NamedTuple):
    """A message of several frames."""

    group: int
    source: int
    data: bytes | bytearray
    time: float
    """Of its announcement, s: the data are of then."""


@dataclass(slots=True)
class _Transfer:
    group: int
    size: int
    begun: float
    latest: float
    """s; time of its last frame."""
    data: bytearray = field(default_factory=bytearray)
    """Of the packets so far."""


class Assembler:
    """Puts the packets of each sender together; a message of which a packet is missing is dropped and counted."""

    def __init__(self, groups: Collection[int]) -> None:
        """Only messages of these parameter groups are put together."""
        self.broken = PassingFault()
        """Messages that were announced and are incomplete."""
        self.latency = 0.0
        """s from the announcement of the latest message to its last frame."""
        self._groups = frozenset(groups)
        self._transfers: dict[NodePair, _Transfer] = {}

    def take(self, group: int, pair: NodePair, data: bytes | bytearray, time: float) -> WholeMessage | None:
        """Take a frame of the protocol, and return the message that it completes."""
        if len(data) < 1 + PACKET_BYTES:
            return None
        if group == MANAGEMENT:
            self._manage(pair, data, time)
            return None
        if (transfer := self._transfers.get(pair)) is None:
            return None  # of another group, or it began before listening did
        following = len(transfer.data) // PACKET_BYTES + 1
        if data[0] != following or time - transfer.latest > MAX_PAUSE:
            self._drop(pair, time)
            return None
        transfer.data += data[1 : 1 + PACKET_BYTES]
        transfer.latest = time
        if len(transfer.data) < transfer.size:
            return None
        del self._transfers[pair]
        self.latency = time - transfer.begun
        return WholeMessage(transfer.group, pair[0], bytes(transfer.data[: transfer.size]), transfer.begun)

    def _manage(self, pair: NodePair, data: bytes | bytearray, time: float) -> None:
        back = pair[1], pair[0]  # of the transfer that a receiver controls
        kind, group = data[0], int.from_bytes(data[5:8], "little")
        if kind in (BAM, RTS):
            self._drop(pair, time)
            size = int.from_bytes(data[1:3], "little")
            is_possible = MIN_BYTES <= size <= MAX_BYTES and data[3] == -(-size // PACKET_BYTES)
            if group in self._groups and is_possible:
                self._transfers[pair] = _Transfer(group, size, time, time)
        elif kind == CTS:  # from the receiver, who may ask for packets again, or (for 0 packets) to wait
            transfer, known = self._transfers.get(back), PACKET_BYTES * (data[2] - 1)
            if transfer is not None and data[1] and not 0 <= known <= len(transfer.data):
                self._drop(back, time)
            elif transfer is not None:
                transfer.latest = time
                del transfer.data[known if data[1] else len(transfer.data) :]
        elif kind in (END, ABORT):
            self._drop(back, time)
            self._drop(pair, time)

    def _drop(self, pair: NodePair, time: float) -> None:
        if self._transfers.pop(pair, None) is not None:
            self.broken.note("a message of several frames is incomplete", time)
