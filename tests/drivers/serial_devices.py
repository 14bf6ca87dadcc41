"""A Modbus device on a serial line, for tests: a pseudo-terminal with somebody at its other end."""

import os
import select
import struct
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager

from pymodbus.framer import FramerRTU

from tests.drivers.modbus_servers import Words


@contextmanager
def serial_device(words: Words, device: int) -> Iterator[str]:
    """A Modbus RTU device at the end of a pseudo-terminal; the path of the port. Nobody else is on the line."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    done = threading.Event()

    def serve() -> None:
        while not done.is_set():
            if not select.select([ours], [], [], 0.05)[0]:
                continue
            request = os.read(ours, 8)
            asked, function, address, count = struct.unpack(">BBHH", request[:6])
            if asked != device or request[6:] != _checksum(request[:6]):
                continue
            found = [words.get(at, 0) for at in range(address, address + count)]
            reply = bytes([device, function, 2 * count]) + struct.pack(f">{count}H", *found)
            os.write(ours, reply + _checksum(reply))

    thread = threading.Thread(target=serve, name="serial-device")
    thread.start()
    try:
        yield os.ttyname(theirs)
    finally:
        done.set()
        thread.join(5.0)
        os.close(ours)
        os.close(theirs)


def _checksum(data: bytes) -> bytes:
    return struct.pack(">H", FramerRTU.compute_CRC(data))
