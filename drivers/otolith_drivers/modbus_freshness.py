"""Whether registers were renewed since they were last read: an old image under a new time would be a lie. Pure.

Registers with noise in them never say the same twice; where they do so now and then, the device was late. Where they do
so often, they are coarse, the machine stands still, or the device renews them more slowly than they are read. Registers
that move by a few steps only may repeat by chance; an old image of them is off by no more than these steps. One image
that comes twice is the beat of two clocks that are equally fast: it is off by less than a period, and is let pass.
"""

from collections.abc import Sequence

from otolith_drivers.modbus_plan import Request

SELDOM = 0.1  # share of readings that repeat the one before, below which one that does is old
OFTEN = 0.6  # share, above which the user should know
MEMORY = 0.01  # of a share: how much a reading counts
SETTLED = 200  # readings, before which a share says more of its beginning than of them
FEW_STEPS = 16  # of a register, from reading to reading
COARSE = 0.5  # share of readings that move by so few, above which registers are coarse
MOST_IN_A_ROW = 100  # old images; what says the same for longer stands still


class Freshness:
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
        return repeated, 1 < in_a_row <= MOST_IN_A_ROW and beats < SELDOM and coarse < COARSE

    def complaints(self, requests: Sequence[Request], period: float) -> list[str]:
        """Which of ``requests`` say the same too often to be read every ``period`` s, a line each."""
        shares = {entry: self._shares[entry] for entry in requests if self._readings.get(entry, 0) >= SETTLED}
        return [
            f"{request.describe()} say the same in {share:.0%} of the readings: the machine stands still, or they are "
            f"renewed more slowly than every {period * 1e3:g} ms"
            for request, share in shares.items()
            if OFTEN < share < 1.0 - MEMORY
        ]


def _near(before: Sequence[int], after: Sequence[int]) -> bool:
    """Whether no register has moved by more than a few steps, the shorter way round."""
    steps = ((new - old) % 65536 for old, new in zip(before, after, strict=True))
    return all(step <= FEW_STEPS or step >= 65536 - FEW_STEPS for step in steps)
