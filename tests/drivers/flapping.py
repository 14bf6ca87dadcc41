"""Drivers on a real bus that can be broken at will, with their pauses shortened; for a process of its own."""

import contextlib
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import can

from otolith_drivers.base import Driver, Setup, Signal
from otolith_drivers.canbus import driver as can_receiver
from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.canbus.signals import CanSource
from otolith_drivers.modbus import driver as modbus_poller
from tests.conftest import EXAMPLES, free_port
from tests.drivers.modbus_servers import Behaviour, odd_server

SHORT = 0.001  # s
PERIOD = 0.002  # s


@contextmanager
def can_rig() -> Iterator[tuple[Driver, Callable[[], None]]]:
    """A bus whose socket stops to be one."""
    place = BusOptions(interface="udp_multicast", channel="239.74.163.8", port=free_port(socket.SOCK_DGRAM))
    opened: list[can.BusABC] = []

    def remembered(*arguments: object, **options: object) -> can.BusABC:
        opened[:] = [open_bus(*arguments, **options)]  # type: ignore[arg-type]
        return opened[0]

    vars(can_receiver).update(open_bus=remembered, BACKOFF_FIRST=SHORT)
    options = can_receiver.Options(**place.model_dump(), dbc=Path("dc-motor.dbc"))
    signals = (Signal("i", "A", CanSource(signal="ArmatureCurrent")),)
    sender, stop = open_bus(place), threading.Event()

    def speak() -> None:
        counter = 0
        while not stop.wait(PERIOD):
            data = bytes(7) + bytes([counter % 256])
            sender.send(can.Message(arbitration_id=385, data=data, is_extended_id=False))
            counter += 1

    speaker = threading.Thread(target=speak)
    speaker.start()
    nowhere = os.open(os.devnull, os.O_RDONLY)

    def flap() -> None:
        os.dup2(nowhere, opened[0].fileno())  # the kernel says from now on that this is no socket

    try:
        yield can_receiver.build(options, Setup(signals, EXAMPLES, PERIOD)), flap
    finally:
        stop.set()
        speaker.join()
        sender.shutdown()
        os.close(nowhere)


@contextmanager
def modbus_rig() -> Iterator[tuple[Driver, Callable[[], None]]]:
    """A server that cuts its connections."""
    modbus_poller.BACKOFF_FIRST = SHORT
    port = free_port(socket.SOCK_STREAM)
    words = dict(enumerate(struct.unpack(">2H", struct.pack(">f", 24.0))))
    options = modbus_poller.Options(host="127.0.0.1", port=port)
    source = modbus_poller.Source.model_validate({"register": 0, "type": "float32", "unit": "V"})
    with odd_server(Behaviour(words), port) as server:

        def flap() -> None:
            while not server.connections:
                time.sleep(SHORT)
            for connection in list(server.connections):
                with contextlib.suppress(OSError):  # cut by the driver itself meanwhile
                    connection.shutdown(socket.SHUT_RDWR)

        yield modbus_poller.build(options, Setup((Signal("u", "V", source),), Path(), PERIOD)), flap


RIGS: dict[str, Callable[[], AbstractContextManager[tuple[Driver, Callable[[], None]]]]] = {
    "can": can_rig,
    "modbus": modbus_rig,
}
