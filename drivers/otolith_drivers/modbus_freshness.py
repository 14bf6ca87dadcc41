"""Whether registers were renewed since they were last read: an old image under a new time would be a lie. Pure.

Registers with noise in them never say the same twice; where they do so now and then, the device was late. Where they do
so often, they are coarse, the machine stands still, or the device renews them more slowly than they are read.
"""

from collections.abc import Sequence

from otolith_drivers.modbus_plan import Request

SELDOM = 0.1  # share of readings that repeat the one before, below which one that does is old
OFTEN = 0.6  # share, above which the user should know
MEMORY = 0.01  # of a share: how much a reading counts


class Freshness:
    """Of all requests of a driver."""

    def __init__(self) -> None:
        self._images: dict[Request, Sequence[int]] = {}
        self._shares: dict[Request, float] = {}

    def take(self, request: Request, registers: Sequence[int]) -> tuple[bool, bool]:
        """Whether they repeat the ones before, and whether they are old because of that."""
        repeated = self._images.get(request) == registers
        self._images[request] = registers
        share = self._shares.get(request, 1.0)  # until it has shown otherwise, a device may repeat itself
        self._shares[request] = share + MEMORY * (repeated - share)
        return repeated, repeated and share < SELDOM

    def complaints(self, period: float) -> list[str]:
        """Which registers say the same too often to be read every ``period`` s, a line each."""
        return [
            f"{request.describe()} say the same in {share:.0%} of the readings: the machine stands still, or they are "
            f"renewed more slowly than every {period * 1e3:g} ms"
            for request, share in list(self._shares.items())
            if OFTEN < share < 1.0 - MEMORY
        ]
