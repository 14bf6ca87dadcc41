"""What a CANopen drive says of itself beside its values: emergencies and heartbeats (CiA 301). No clock in here."""

from collections.abc import Callable

from otolith_drivers.can_vigilance import Pace, period_text

HEARTBEAT = 0x700
STATES = {0x00: "starting up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}
OPERATIONAL = 0x05
CAUSES = {
    0x10: "generic",
    0x20: "current",
    0x21: "current at the input",
    0x22: "current inside",
    0x23: "current at the output",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "temperature of the device",
    0x50: "hardware",
    0x60: "software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x71: "power",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x84: "speed control",
    0x86: "position control",
    0x90: "external",
    0xF0: "additional functions",
    0xFF: "of the maker's own",
}
"""High byte of the code, by CiA 301 and CiA 402."""
Note = Callable[[bytes | bytearray, float], None]


class NodeWatch:
    """Listens to one node."""

    def __init__(self, node: int, emergency: int) -> None:
        """``emergency`` is the arbitration ID of its emergencies."""
        self.node = node
        self._emergency = emergency
        self._code = 0
        self._at = 0.0
        self._state: int | None = None
        self._beat = Pace()

    def frames(self) -> dict[int, Note]:
        """Which frames it is to be shown."""
        return {self._emergency: self._note_emergency, HEARTBEAT + self.node: self._note_heartbeat}

    def complaints(self, now: float) -> list[str]:
        """What is wrong at ``now`` (s), a line each."""
        lines = []
        if self._code:
            cause = CAUSES.get(self._code >> 8) or CAUSES.get(self._code >> 8 & 0xF0, "unknown")
            age = max(now - self._at, 0.0)
            lines.append(f"drive {self.node} reports emergency 0x{self._code:04X} ({cause}), {age:.1f} s ago")
        if self._state is not None and self._state != OPERATIONAL:
            state = STATES.get(self._state, f"in state 0x{self._state:02X}")
            lines.append(f"drive {self.node} is not operational, but {state}: it sends no process data")
        if (silence := self._beat.silent_for(now)) is not None:
            came = period_text(self._beat.period or 0.0)
            lines.append(f"the heartbeat of drive {self.node} has been away for {silence:.1f} s; it came every {came}")
        return lines

    def _note_emergency(self, data: bytes | bytearray, time: float) -> None:
        if len(data) >= 2:  # a code of 0 takes back what was reported
            self._code, self._at = int.from_bytes(data[:2], "little"), time

    def _note_heartbeat(self, data: bytes | bytearray, time: float) -> None:
        if data:
            self._state = data[0] & 0x7F  # the highest bit toggles where a master guards the node
            self._beat.note(time)
