"""The answer to a request in the bytes that came: its frame is looked for, and what is none gets a named cause.

A serial line delivers more than the answer: a byte when an RS-485 adapter switches its driver, the echo of the request,
or frames of other devices. The frame of the answer is known from the request: device, function and number of bytes; on
a serial line its checksum decides.
"""

import math
from typing import Protocol

from pymodbus.framer import FramerRTU

from otolith_drivers.modbus.options import LineOptions

HEADER_LENGTH = 7  # bytes of a TCP answer before its function code
REPEATED_FIELDS = (("reply_transaction", "transaction", 0, 2), ("reply_device", "device", 6, 7))
REFUSAL = 0x80  # in the function code of an answer that is an exception
BIT_FUNCTIONS = (1, 2)
SHOWN_BYTES = 12  # of what is no answer


class FrameFilter(Protocol):
    """Takes what is sent and what came since then; returns what to send, and the frame of the answer if it is there."""

    fault: str
    """Why what came since the latest request is no answer; empty if nothing came, or the answer is there."""

    def __call__(self, sending: bool, data: bytes) -> bytes: ...


class SerialFilter:
    """Finds the answer among all bytes that came from a serial line.

    The echo of the request is removed first: with its checksum, a request may be a valid answer.
    """

    def __init__(self) -> None:
        self.fault = ""
        self._sent = b""

    def __call__(self, sending: bool, data: bytes) -> bytes:
        if sending:
            self._sent, self.fault = data, ""
            return data
        before, echo, after = data.partition(self._sent)
        received = after if echo else before
        frames = (received[at : at + size] for at in range(len(received)) for size in self._sizes(received[at:]))
        answer = next((frame for frame in frames if _is_whole(frame)), b"")
        self.fault = "" if answer else self._cause(received, is_echo=bool(echo))
        return answer

    def _sizes(self, data: bytes) -> list[int]:
        """Return how long the answer is that ``data`` begins with; nothing if it does not."""
        if data[:1] != self._sent[:1]:
            return []
        size = _body_size(self._sent[1:], data[1:])
        return [] if size is None or len(data) < size + 3 else [size + 3]

    def _cause(self, received: bytes, *, is_echo: bool) -> str:
        if not received:
            return "only the echo of the request" if is_echo else ""
        if received[0] != self._sent[0] and _is_whole(received) and len(received) > 4:
            return f"an answer of device {received[0]} instead of {self._sent[0]}"
        if received[:2] == self._sent[:2]:
            if len(received) > 2 and _is_whole(received):
                return f"an answer to another request: {received[2]} bytes instead of {_asked_bytes(self._sent[1:])}"
            return (
                "an answer that is cut or has a wrong checksum: do two devices have this number, is the line disturbed?"
            )
        shown = received[:SHOWN_BYTES].hex(" ") + (" ..." if len(received) > SHOWN_BYTES else "")
        return f"bytes that are no answer ({shown}): are baudrate, parity and stop_bits those of the device?"


class TcpFilter:
    """Checks the transaction and device number of each TCP answer, and replaces those that the options expect.

    A wrong length in the header is replaced if the answer itself is as long as the request asks.
    """

    def __init__(self, options: LineOptions) -> None:
        self.fault = ""
        self._options = options
        self._sent = b""

    def __call__(self, sending: bool, data: bytes) -> bytes:
        if sending:
            self._sent, self.fault = data, ""
            return data
        answers, at = bytearray(data), 0
        while at + HEADER_LENGTH <= len(answers):
            if any(data[at + 2 : at + 4]):  # the number of the protocol is 0
                is_serial = data[at : at + 2] == self._sent[6:8]
                kind = 'an answer of a serial line: set framing = "rtu" in [driver]' if is_serial else ""
                self.fault = kind or "bytes that are no answer of Modbus TCP"
                break
            for name, what, begin, end in REPEATED_FIELDS:
                number, sent = (int.from_bytes(part) for part in (data[at + begin : at + end], self._sent[begin:end]))
                if number == sent:
                    continue
                if number == getattr(self._options, name):
                    answers[at + begin : at + end] = self._sent[begin:end]
                else:
                    self.fault = (
                        f"an answer with {what} number {number} instead of {sent}: "
                        f"if the device always answers so, set {name} = {number} in [driver]"
                    )
            size = _body_size(self._sent[HEADER_LENGTH:], data[at + HEADER_LENGTH :])
            if size is not None and at + HEADER_LENGTH + size <= len(data):
                answers[at + 4 : at + 6] = (size + 1).to_bytes(2)
            at += 6 + max(1, int.from_bytes(answers[at + 4 : at + 6]))
        return bytes(answers)


def _asked_bytes(request: bytes) -> int:
    """Return how many bytes of values a ``request``, from its function code on, asks for."""
    count = int.from_bytes(request[3:5])
    return math.ceil(count / 8) if request[0] in BIT_FUNCTIONS else 2 * count


def _body_size(request: bytes, answer: bytes) -> int | None:
    """Return the length of an ``answer`` to the ``request``, both from the function code on; None if it is none."""
    if answer[:1] == bytes([request[0] | REFUSAL]):
        return 2
    asked = _asked_bytes(request)
    return 2 + asked if answer[:2] == bytes([request[0], asked & 0xFF]) else None


def _is_whole(frame: bytes) -> bool:
    """Whether a serial frame has the checksum of its content."""
    return FramerRTU.compute_CRC(frame[:-2]).to_bytes(2) == frame[-2:]
