"""A rig for each driver of the registry: the driver, and a real source for it."""

import struct
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

import can

from otolith_drivers import mqtt as mqtt_driver
from otolith_drivers.base import Setup, Signal
from otolith_drivers.canbus import driver as can_driver
from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.conformance import Rig
from otolith_drivers.modbus import driver as modbus_driver
from otolith_drivers.opcua import driver as opcua_driver
from otolith_drivers.plant import realtime as plant_driver
from otolith_drivers.replay import driver as replay_driver
from tests.conftest import EXAMPLES, OwnMachine
from tests.drivers.modbus_servers import library_server
from tests.drivers.mqtt_broker import broker_of_this_process, publisher
from tests.drivers.opcua_server import server_of_this_process

SIGNALS = (
    Signal("i", "A", can_driver.Source(signal="ArmatureCurrent")),
    Signal("omega", "rpm", can_driver.Source(signal="RotorSpeed")),
)
SETUP = Setup(SIGNALS, EXAMPLES, 0.01)
EXPECTED = {"i": 2.0, "omega": 10.0 * 60 / (2 * 3.141592653589793)}


@contextmanager
def can_rig(machine: OwnMachine) -> Iterator[Rig]:
    options = can_driver.Options(
        interface="udp_multicast", channel=machine.group, port=machine.port, dbc=Path("dc-motor.dbc")
    )
    bus = open_bus(BusOptions(**options.model_dump(include=set(BusOptions.model_fields))))

    def emit() -> None:
        bus.send(
            can.Message(
                arbitration_id=385, data=bytes(2) + (2000).to_bytes(2, "little") + bytes(4), is_extended_id=False
            )
        )
        bus.send(can.Message(arbitration_id=641, data=(1000).to_bytes(2, "little") + bytes(6), is_extended_id=False))

    yield Rig(can_driver.build(options, SETUP), EXPECTED, emit)
    bus.shutdown()


def modbus_source(register: int, unit: str) -> modbus_driver.Source:
    return modbus_driver.Source.model_validate({"register": register, "type": "float32", "unit": unit})


@contextmanager
def modbus_rig(_: OwnMachine) -> Iterator[Rig]:
    words = dict(enumerate(struct.unpack(">4H", struct.pack(">ff", 2.0, 10.0))))
    signals = (Signal("i", "A", modbus_source(0, "A")), Signal("omega", "rpm", modbus_source(2, "rad/s")))
    with library_server(words) as port:
        options = modbus_driver.Options(host="127.0.0.1", port=port)
        driver = modbus_driver.build(options, replace(SETUP, signals=signals))
        yield Rig(driver, EXPECTED)
        driver.close()


@contextmanager
def opcua_rig(_: OwnMachine) -> Iterator[Rig]:
    """The server gives the unit of the current."""
    sources = ({"node": "ns=2;s=i"}, {"node": "nsu=urn:motor;s=omega", "unit": "rad/s"})
    signals = tuple(
        replace(signal, source=opcua_driver.Source.model_validate(source))
        for signal, source in zip(SIGNALS, sources, strict=True)
    )
    port = server_of_this_process()
    options = opcua_driver.Options(endpoint=f"opc.tcp://127.0.0.1:{port}/motor")
    yield Rig(opcua_driver.build(options, replace(SETUP, signals=signals)), EXPECTED)


@contextmanager
def mqtt_rig(_: OwnMachine) -> Iterator[Rig]:
    """One topic has a plain number, the other one a document."""
    port = broker_of_this_process()
    topic = f"rig/{time.monotonic_ns()}"
    sources = ({"topic": f"{topic}/i", "unit": "A"}, {"topic": topic, "field": "axes[0].speed", "unit": "rad/s"})
    signals = tuple(
        replace(signal, source=mqtt_driver.Source.model_validate(source))
        for signal, source in zip(SIGNALS, sources, strict=True)
    )
    with publisher(port) as client:

        def emit() -> None:
            client.publish(f"{topic}/i", "2.0")
            client.publish(topic, '{"axes": [{"speed": 10}]}')

        options = mqtt_driver.Options(host="127.0.0.1", port=port)
        yield Rig(mqtt_driver.build(options, replace(SETUP, signals=signals)), EXPECTED, emit)


PLANT_FAULT = """
[[faults]]
kind = "{kind}"
signal = "{signal}"
{change}
start = "0 s"
"""


@contextmanager
def plant_rig(machine: OwnMachine) -> Iterator[Rig]:
    """Faulty sensors of the plant measure the expected values."""
    wanted = {"ArmatureCurrent": "2 A", "RotorSpeed": "10 rad/s"}
    for signal, value in wanted.items():
        with machine.scenario.open("a", encoding="utf-8") as file:
            file.write(PLANT_FAULT.format(kind="gain", signal=signal, change="factor = 0"))
            file.write(PLANT_FAULT.format(kind="offset", signal=signal, change=f'amount = "{value}"'))
    signals = tuple(
        Signal(signal.name, signal.unit, plant_driver.Source(signal=name))
        for signal, name in zip(SIGNALS, wanted, strict=True)
    )
    options = plant_driver.Options(scenario=machine.scenario)
    yield Rig(plant_driver.build(options, replace(SETUP, signals=signals)), EXPECTED)


@contextmanager
def replay_rig(machine: OwnMachine) -> Iterator[Rig]:
    """A file sends by itself."""
    path = machine.machine.with_name("drive.csv")
    lines = ["t,ArmatureCurrent [A],RotorSpeed", *(f"{0.01 * index:.2f},2.0,10.0" for index in range(10_000))]
    path.write_text("\n".join(lines), encoding="utf-8")
    sources = ({"column": "ArmatureCurrent"}, {"column": "RotorSpeed", "unit": "rad/s"})
    signals = tuple(
        replace(signal, source=replay_driver.Source.model_validate(source))
        for signal, source in zip(SIGNALS, sources, strict=True)
    )
    yield Rig(replay_driver.build(replay_driver.Options(file=path), replace(SETUP, signals=signals)), EXPECTED)


RIGS: dict[str, Callable[[OwnMachine], AbstractContextManager[Rig]]] = {
    "can": can_rig,
    "modbus": modbus_rig,
    "mqtt": mqtt_rig,
    "opcua": opcua_rig,
    "plant": plant_rig,
    "replay": replay_rig,
}
