"""Which requests are worth sending now: one dead device or refused register never costs the others. Pure: no clock.

A device that does not answer is left alone for a while, longer each time, and tried again for ever. A request that is
refused is split until only what the device does not have is left out.
"""

from dataclasses import dataclass, field

from otolith_drivers.modbus_failures import GATEWAY_CODES, Refused
from otolith_drivers.modbus_plan import Request, split

PATIENCE = 3  # failures in a row before something is left alone
FIRST_REST, LONGEST_REST = 1.0, 10.0  # s
STRUCTURAL = (1, 2, 3)  # exceptions that say "never", not "not now"


@dataclass(slots=True)
class Rest:
    """How a request or a device has fared."""

    failures: int = 0
    fault: str = ""
    since: float = 0.0
    """s, of the first failure."""
    until: float = 0.0
    """s; not tried before."""

    def fail(self, fault: str, now: float, patience: int) -> None:
        """Note a failure; from ``patience`` in a row on it rests, twice as long each time."""
        if not self.failures:
            self.since = now
        self.failures += 1
        self.fault = fault
        if self.failures >= patience:
            self.until = now + min(FIRST_REST * 2.0 ** (self.failures - patience), LONGEST_REST)

    def recover(self) -> None:
        """It works."""
        self.failures, self.fault, self.until = 0, "", 0.0

    @property
    def resting(self) -> bool:
        """Whether it is given up for now."""
        return self.until > 0.0


@dataclass(slots=True)
class Requests:
    """All requests of a driver, and the health of each and of each device."""

    requests: tuple[Request, ...]
    _requests: dict[Request, Rest] = field(default_factory=dict)
    _devices: dict[int, Rest] = field(default_factory=dict)

    def due(self, now: float) -> list[Request]:
        """Those worth sending now, doubtful devices last; of such a device only one, to ask whether it is back."""
        chosen: list[Request] = []
        asked: set[int] = set()
        for request in sorted(self.requests, key=lambda request: self._device(request).failures > 0):
            device = self._device(request)
            if now < device.until or now < self._request(request).until:
                continue
            if device.failures and request.device in asked:
                continue
            asked.add(request.device)
            chosen.append(request)
        return chosen

    def answered(self, request: Request) -> None:
        """It was read."""
        self._device(request).recover()
        self._request(request).recover()

    def silent(self, request: Request, fault: str, now: float) -> None:
        """Its device did not answer."""
        self._device(request).fail(fault, now, PATIENCE)

    def refused(self, request: Request, error: Refused, now: float) -> None:
        """The device answered with an exception."""
        if error.code in GATEWAY_CODES:
            self.silent(request, str(error), now)
            return
        self._device(request).recover()
        parts = split(request) if error.code in STRUCTURAL and len(request.items) > 1 else (request,)
        if len(parts) > 1:
            at = self.requests.index(request)
            self.requests = (*self.requests[:at], *parts, *self.requests[at + 1 :])
            self._requests.pop(request, None)
            return
        self._request(request).fail(str(error), now, 1 if error.code in STRUCTURAL else PATIENCE)

    @property
    def all_silent(self) -> bool:
        """Whether no device answers."""
        devices = {request.device for request in self.requests}
        return all(self._devices.get(device, Rest()).resting for device in devices)

    def complaints(self, now: float) -> list[str]:
        """What is left alone and why, a line each."""
        lines = [
            f"device {number} does not answer for {now - rest.since:.0f} s: {rest.fault}; tried again"
            for number, rest in list(self._devices.items())
            if rest.resting
        ]
        for request, rest in list(self._requests.items()):
            if rest.resting:
                names = ", ".join(item.name for item in request.items)
                lines.append(f"{names}: {request.describe()} refused: {rest.fault}; tried again now and then")
        return lines

    def _device(self, request: Request) -> Rest:
        return self._devices.setdefault(request.device, Rest())

    def _request(self, request: Request) -> Rest:
        return self._requests.setdefault(request, Rest())
