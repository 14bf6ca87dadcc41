"""Drivers on a real bus that is broken on demand; for a process of its own."""

import contextlib
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import can

from otolith_drivers.base import Driver, Setup, Signal
from otolith_drivers.canbus import channel as can_channel
from otolith_drivers.canbus import driver as can_receiver
from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.canbus.options import CanSource
from otolith_drivers.common import reconnection
from otolith_drivers.modbus import driver as modbus_poller
from tests.conftest import EXAMPLES, free_port
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.waiting import wait_for

SHORT = 0.001  # s
PERIOD = 0.002  # s


@contextmanager
def can_rig() -> Iterator[tuple[Driver, Callable[[], None]]]:
    """The CAN driver, and a function that makes the socket of its bus invalid."""
    reconnection.BACKOFF_FIRST, reconnection.LASTING = SHORT, 0.0  # the time between two failures is shortened too
    options = BusOptions(interface="udp_multicast", channel="239.74.163.8", port=free_port(socket.SOCK_DGRAM))
    opened: list[can.BusABC] = []  # at most one: the latest that has not been broken yet

    def open_and_remember(*arguments: object, **more: object) -> can.BusABC:
        bus = open_bus(*arguments, **more)  # type: ignore[arg-type]
        opened[:] = [bus]
        return bus

    vars(can_channel).update(open_bus=open_and_remember)
    signals = (Signal("i", "A", CanSource(signal="ArmatureCurrent")),)
    driver = can_receiver.build(
        can_receiver.Options(**options.model_dump(), dbc=Path("dc-motor.dbc")), Setup(signals, EXAMPLES, PERIOD)
    )
    sender, stop = open_bus(options), threading.Event()

    def send() -> None:
        counter = 0
        while not stop.wait(PERIOD):
            data = bytes(7) + bytes([counter % 256])
            sender.send(can.Message(arbitration_id=385, data=data, is_extended_id=False))
            counter += 1

    thread = threading.Thread(target=send)
    thread.start()
    no_socket = os.open(os.devnull, os.O_RDONLY)

    def flap() -> None:
        """Break a bus once. While the driver is reopening it, there is no descriptor to break: wait for the next."""
        wait_for(lambda: bool(opened))
        bus = opened.pop()
        descriptor = bus.fileno()
        os.dup2(no_socket, descriptor)  # the kernel reports from now on that this is no socket
        if bus.fileno() != descriptor:  # the driver has closed it meanwhile: this one is ours, or is closed as well
            with contextlib.suppress(OSError):
                os.close(descriptor)

    try:
        yield driver, flap
    finally:
        stop.set()
        thread.join()
        sender.shutdown()
        os.close(no_socket)


@contextmanager
def modbus_rig() -> Iterator[tuple[Driver, Callable[[], None]]]:
    """The Modbus driver, and a function that cuts its connection."""
    reconnection.BACKOFF_FIRST, reconnection.LASTING = SHORT, 0.0  # the time between two failures is shortened too
    port = free_port(socket.SOCK_STREAM)
    registers = dict(enumerate(struct.unpack(">2H", struct.pack(">f", 24.0))))
    source = modbus_poller.Source.model_validate({"register": 0, "type": "float32", "unit": "V"})
    setup = Setup((Signal("u", "V", source),), Path(), PERIOD)
    with odd_server(Behaviour(registers), port) as server:
        driver = modbus_poller.build(modbus_poller.Options(host="127.0.0.1", port=port), setup)
        cut: set[socket.socket] = set()

        def flap() -> None:
            """Cut a connection once. One that was cut may still be listed until the server's thread has noticed."""
            wait_for(lambda: bool(server.connections - cut))
            cut.intersection_update(server.connections)
            for connection in server.connections - cut:
                cut.add(connection)
                with contextlib.suppress(OSError):  # the driver itself has closed it meanwhile
                    connection.shutdown(socket.SHUT_RDWR)

        yield driver, flap


RIGS: dict[str, Callable[[], AbstractContextManager[tuple[Driver, Callable[[], None]]]]] = {
    "can": can_rig,
    "modbus": modbus_rig,
}
