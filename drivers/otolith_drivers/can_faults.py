"""What a bus says of itself in error frames, in the classes of Linux (``linux/can/error.h``). No clock in here."""

from collections import Counter

import can

RECENT = 10.0  # s for which the last error is complained of
STATE_HOLDS = 60.0  # s for which the controller is taken to be in the state it last reported

BUS_OFF, RESTARTED, CONTROLLER = 0x40, 0x100, 0x04
CLASSES: dict[int, str] = {
    0x01: "sending timed out",
    0x02: "arbitration lost",
    CONTROLLER: "trouble of the controller",
    0x08: "protocol violated",
    0x10: "trouble of the transceiver",
    0x20: "no acknowledgement",
    BUS_OFF: "bus off",
    0x80: "bus error",
    RESTARTED: "controller restarted",
}
CONTROLLER_STATES: dict[int, str] = {
    0x10: "error passive (receiving)",
    0x20: "error passive (sending)",
    0x04: "many errors (receiving)",
    0x08: "many errors (sending)",
}
OVERFLOW_RECEIVING, ACTIVE_AGAIN = 0x01, 0x40  # bits of the first data byte beside those states


def classes_of(frame: can.Message) -> list[str]:
    """What an error frame says, in words; an interface that does not tell classes has 0 there."""
    return [name for bit, name in CLASSES.items() if frame.arbitration_id & bit] or ["error frame"]


class BusFaults:
    """Counts error frames by their class, and knows whether the controller has left the bus."""

    def __init__(self) -> None:
        self.bus_off = False
        """Until a frame comes, or the bus is opened anew."""
        self.total = 0
        """Error frames, each of which may be of several classes."""
        self.counts: Counter[str] = Counter()
        """By what they say."""
        self.overflows = 0
        """Times that the controller had no room for a frame."""
        self._state = ""
        self._latest = ""
        self._at = 0.0

    def note(self, frame: can.Message, time: float) -> None:
        """An error frame, which came at ``time`` (s)."""
        self.total += 1
        bits, names = frame.arbitration_id, classes_of(frame)
        if bits & CONTROLLER and len(frame.data) > 1:
            names = [self._of_controller(frame.data[1]) if name == CLASSES[CONTROLLER] else name for name in names]
        self.counts.update(names)
        if bits & BUS_OFF:
            self.bus_off = True
        if bits & RESTARTED:
            self.bus_off, self._state = False, ""
        self._latest, self._at = ", ".join(names), time

    def complaints(self, now: float) -> list[str]:
        """What is wrong at ``now`` (s), a line each."""
        if not self.total:
            return []
        lines = []
        age = now - self._at
        if self._state and age < STATE_HOLDS:
            lines.append(f"the CAN controller is {self._state}: look at cable, termination and bit rate")
        if age < RECENT:
            lines.append(f"{self.total} error frames on the bus, the latest {max(age, 0.0):.1f} s ago: {self._latest}")
        return lines

    def _of_controller(self, status: int) -> str:
        if status & OVERFLOW_RECEIVING:
            self.overflows += 1
        if status & ACTIVE_AGAIN:
            self._state = ""
            return "error active again"
        for bit, name in CONTROLLER_STATES.items():
            if status & bit:
                self._state = name
                return name
        return "controller had no room for a frame" if status & OVERFLOW_RECEIVING else CLASSES[CONTROLLER]
