"""A Modbus RTU device for tests: a thread at the other end of a pseudo-terminal."""

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
    """The only Modbus RTU device on a pseudo-terminal; yields the path of the port."""
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
            registers = [words.get(at, 0) for at in range(address, address + count)]
            reply = bytes([device, function, 2 * count]) + struct.pack(f">{count}H", *registers)
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
