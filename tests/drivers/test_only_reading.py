"""The drivers only read: looked at on the wire, and in the code for what could ever write."""

import ast
import os
import threading
import time
from pathlib import Path

import can
import pytest

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.canbus import driver as can_receiver
from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.canbus.signals import Source
from tests.conftest import EXAMPLES, OwnMachine
from tests.waiting import PATIENCE

DRIVERS = Path(can_receiver.__file__).parents[1]
WRITES = {
    *("send", "send_periodic", "sendto", "sendall", "sdo", "nmt", "write_coil", "write_coils", "write_register"),
    *("write_registers", "mask_write_register", "readwrite_registers", "write_file_record"),
}
SOURCES = [Source(signal="ArmatureCurrent"), Source(id=0x281, start=0, length=16, unit="A")]


@pytest.mark.parametrize("source", SOURCES, ids=["database", "bits"])
def test_a_tap_on_the_bus_hears_nobody_but_the_machine(source: Source, own_machine: OwnMachine) -> None:
    """Through opening, frames that are good and bad, a bus that breaks, opening anew, and closing."""
    place = BusOptions(interface="udp_multicast", channel=own_machine.group, port=own_machine.port)
    options = can_receiver.Options(**place.model_dump(), dbc=Path("dc-motor.dbc"))
    driver = can_receiver.build(options, Setup((Signal("i", "A", source),), EXAMPLES, 0.01))
    tap, machine, heard, sent = open_bus(place), open_bus(place), list[can.Message](), 0
    done = threading.Event()

    def listen() -> None:
        while not done.is_set():
            if (frame := tap.recv(0.05)) is not None:
                heard.append(frame)

    listener = threading.Thread(target=listen)
    listener.start()
    got: list[Sample] = []
    driver.open(got.extend)
    for identifier in (385, 641, 7):
        for length in range(9):
            frame = can.Message(arbitration_id=identifier, data=bytes(length), is_extended_id=False)
            machine.send(frame)
            sent += 1
    deadline = time.monotonic() + PATIENCE
    while (not got or len(heard) < sent) and time.monotonic() < deadline:
        time.sleep(0.01)
    driver.close()
    time.sleep(0.1)  # what would come would have come
    done.set()
    listener.join()
    tap.shutdown()
    machine.shutdown()
    assert got
    assert len(heard) == sent


def test_an_adapter_that_can_is_told_to_listen_only(own_machine: OwnMachine) -> None:
    """Over a serial line that is tapped: an slcan adapter gets the commands to set it up, and not one frame."""
    adapter, line = os.openpty()
    options = can_receiver.Options(
        interface="slcan", channel=os.ttyname(line), bitrate="500 kbit/s", dbc=own_machine.dbc
    )
    driver = can_receiver.build(options, Setup((Signal("i", "A", SOURCES[0]),), EXAMPLES, 0.01))
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


def test_no_code_of_a_driver_can_write() -> None:
    """The simulated machine, which is no driver of the daemon, is the only one that sends."""
    found = []
    for path in sorted(DRIVERS.rglob("*.py")):
        if "plant" in path.parts:
            continue
        found += [
            f"{path.name}:{node.lineno}: .{node.attr}"
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Attribute) and node.attr in WRITES
        ]
    assert found == []
