"""Several machines at one place, for each driver that shares connections, with a real bus or server."""

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import can
import psutil

from otolith_drivers.base import Driver, Setup, Signal
from otolith_drivers.canbus import driver as can_driver
from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.conformance import Rig, SharedRig
from otolith_drivers.modbus import driver as modbus_driver
from otolith_drivers.opcua import driver as opcua_driver
from tests.conftest import OwnMachine
from tests.drivers.modbus_readers import floats
from tests.drivers.modbus_servers import library_server
from tests.drivers.opcua_server import lasting_server

MACHINES = 3
PERIOD = 0.01  # s


@dataclass(frozen=True)
class Hall(SharedRig):
    """Machines at one place, and how to build another one."""

    build: Callable[[Path, str], Driver]  # One whose signal "p" is at the given address
    absent: str  # Address at which there is nothing
    broken: str  # Address with values that are no readings; empty if a server refuses them


def sockets(port: int, *, local: bool) -> Callable[[], int]:
    """Count the sockets of this process that are bound or connected to ``port``."""

    def count() -> int:
        sockets = psutil.Process().net_connections("inet")
        ends = [each.laddr if local else each.raddr for each in sockets if each.status in ("ESTABLISHED", "NONE")]
        return sum(bool(end) and end.port == port for end in ends)

    return count


@contextmanager
def can_hall(machine: OwnMachine) -> Iterator[Hall]:
    """Each machine sends its number in a frame of its own."""
    place = BusOptions(interface="udp_multicast", channel=machine.group, port=machine.port)
    bus = open_bus(place)

    def build(_: Path, identifier: str) -> Driver:
        source = {"id": identifier, "start": 0, "length": 16, "unit": "V", "range": (0, 100)}
        signal = Signal("p", "V", can_driver.Source.model_validate(source))
        return can_driver.build(can_driver.Options(**place.model_dump()), Setup((signal,), Path(), PERIOD))

    def emit(number: int) -> None:
        for identifier, value in ((0x100 + number, number), (0x1FF, 0xFFFF)):
            data = value.to_bytes(2, "little") + bytes(6)
            bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    rigs = [
        Rig(build(Path(), f"0x{0x100 + number:X}"), {"p": float(number)}, partial(emit, number))
        for number in range(1, MACHINES + 1)
    ]
    yield Hall(rigs, sockets(machine.port, local=True), build, "0x7F0", "0x1FF")
    bus.shutdown()


@contextmanager
def modbus_hall(_: OwnMachine) -> Iterator[Hall]:
    """Each machine has a register of its own behind one host."""
    with library_server(floats(*range(MACHINES + 1), float("nan"))) as port:

        def build(_: Path, register: str) -> Driver:
            source = {"register": int(register), "type": "float32", "unit": "V"}
            signal = Signal("p", "V", modbus_driver.Source.model_validate(source))
            options = modbus_driver.Options(host="127.0.0.1", port=port)
            return modbus_driver.build(options, Setup((signal,), Path(), PERIOD))

        numbers = range(1, MACHINES + 1)
        rigs = [Rig(build(Path(), str(2 * number)), {"p": float(number)}) for number in numbers]
        yield Hall(rigs, sockets(port, local=False), build, "400", str(2 * MACHINES + 2))


@cache
def server_of_hall() -> int:
    """The port of an OPC UA server with a variable of each machine."""
    return lasting_server(bad=(math.nan, "V"), **{f"p{n}": (float(n), "V") for n in range(1, MACHINES + 1)})


@contextmanager
def opcua_hall(_: OwnMachine) -> Iterator[Hall]:
    """Each machine has a variable of its own on one server."""
    port = server_of_hall()

    def build(folder: Path, node: str) -> Driver:
        signal = Signal("p", "V", opcua_driver.Source(node=f"nsu=urn:motor;s={node}", unit="V"))
        options = opcua_driver.Options(endpoint=f"opc.tcp://127.0.0.1:{port}/motor")
        return opcua_driver.build(options, Setup((signal,), folder, PERIOD))

    rigs = [Rig(build(Path(), f"p{number}"), {"p": float(number)}) for number in range(1, MACHINES + 1)]
    yield Hall(rigs, sockets(port, local=False), build, "nothing", "bad")


HALLS: dict[str, Callable[[OwnMachine], AbstractContextManager[Hall]]] = {
    "can": can_hall,
    "modbus": modbus_hall,
    "opcua": opcua_hall,
}
