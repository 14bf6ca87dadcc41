"""The drivers only read: checked on the wire, and in their code for every method that could write."""

import ast
import os
import threading
import time
from pathlib import Path

import can
import pytest

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.canbus import driver as can_driver
from otolith_drivers.canbus.bus import BusOptions, open_bus
from tests.conftest import EXAMPLES, OwnMachine
from tests.waiting import PATIENCE, wait_for

DRIVERS = Path(can_driver.__file__).parents[1]
WRITING_METHODS = {
    *("send", "send_periodic", "sendto", "sendall", "sdo", "nmt", "write_coil", "write_coils", "write_register"),
    *("write_registers", "mask_write_register", "readwrite_registers", "write_file_record"),
    *("publish", "will_set", "write", "write_value", "write_values", "write_attribute", "write_attributes"),
    *("call", "call_method", "set_value", "set_writable", "history_update", "add_variable", "delete_nodes"),
}
SOURCES = [can_driver.Source(signal="ArmatureCurrent"), can_driver.Source(id=0x281, start=0, length=16, unit="A")]


@pytest.mark.parametrize("source", SOURCES, ids=["database", "bits"])
def test_can_driver_sends_no_frame(source: can_driver.Source, own_machine: OwnMachine) -> None:
    """While it opens, receives good and bad frames, and closes."""
    place = BusOptions(interface="udp_multicast", channel=own_machine.group, port=own_machine.port)
    options = can_driver.Options(**place.model_dump(), dbc=Path("dc-motor.dbc"))
    driver = can_driver.build(options, Setup((Signal("i", "A", source),), EXAMPLES, 0.01))
    tap, machine, on_the_bus, sent = open_bus(place), open_bus(place), list[can.Message](), 0
    done = threading.Event()

    def listen() -> None:
        while not done.is_set():
            if (frame := tap.recv(0.05)) is not None:
                on_the_bus.append(frame)

    listener = threading.Thread(target=listen)
    listener.start()
    samples: list[Sample] = []
    driver.open(samples.extend)
    for identifier in (385, 641, 7):
        for length in range(9):
            machine.send(can.Message(arbitration_id=identifier, data=bytes(length), is_extended_id=False))
            sent += 1
    wait_for(lambda: bool(samples) and len(on_the_bus) >= sent)
    driver.close()
    time.sleep(0.1)  # long enough for one more frame to arrive
    done.set()
    listener.join()
    tap.shutdown()
    machine.shutdown()
    assert len(on_the_bus) == sent


def test_can_adapter_is_set_to_listen_only(own_machine: OwnMachine) -> None:
    """An slcan adapter on a tapped serial line gets the commands that set it up, and no frame to send."""
    adapter, line = os.openpty()
    options = can_driver.Options(interface="slcan", channel=os.ttyname(line), bitrate="500 kbit/s", dbc=own_machine.dbc)
    driver = can_driver.build(options, Setup((Signal("i", "A", SOURCES[0]),), EXAMPLES, 0.01))
    written = bytearray()
    opened = threading.Thread(target=driver.open, args=(lambda _: None,))
    opened.start()
    os.set_blocking(adapter, False)
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and b"L\r" not in written:
        try:
            written += os.read(adapter, 100)
        except BlockingIOError:
            time.sleep(0.01)
    opened.join(timeout=PATIENCE)
    os.write(adapter, b"t18180000000000000000\r")
    driver.close()
    os.close(adapter)
    os.close(line)
    commands = bytes(written).split(b"\r")
    assert b"L" in commands
    assert not [command for command in commands if command[:1] in b"tTrRdDbB" and command]


def test_no_driver_calls_a_writing_method() -> None:
    """Only the simulated machine, which is no driver of a real one, sends."""
    calls = [
        f"{path.name}:{node.lineno}: .{node.attr}"
        for path in sorted(DRIVERS.rglob("*.py"))
        if "plant" not in path.parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and node.attr in WRITING_METHODS
    ]
    assert calls == []
