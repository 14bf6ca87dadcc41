"""Machines of a hall whose frames come over virtual CAN buses: their files, and the process that sends for them."""

import csv
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import can

from otolith_drivers.canbus.bus import BusOptions, open_bus

SLICES = 10  # of a period, in which the machines send one after the other
PDOS = {"V_a": (0x180, 0), "T_load": (0x180, 24), "i": (0x280, 0), "omega": (0x280, 24)}
"""First identifier of the frames of each signal, to which the number of the machine on its bus is added; first bit."""
SCALES = {"V_a": 1e-5, "T_load": 1e-7, "i": 1e-6, "omega": 1e-5}
UNITS = {"V_a": "V", "T_load": "N*m", "i": "A", "omega": "rad/s"}
BITS, COUNTER = 24, 48  # of each value; first bit of the counter of each frame
DRIVER = """[driver]
type = "can"
interface = "udp_multicast"
channel = "{group}"
port = {port}
[driver.messages]
"{command}" = {{ counter = {{ start = {counter}, length = 8 }}, period = "10 ms" }}
"{feedback}" = {{ counter = {{ start = {counter}, length = 8 }}, period = "10 ms" }}
[signals]
{signals}
"""


def group(bus: int) -> str:
    """Return the multicast group that is a bus."""
    return f"239.74.170.{bus + 1}"


def free_port() -> int:
    """Return a port of this computer that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return max(int(probe.getsockname()[1]), 1024)


def driver_table(bus: int, port: int, place: int) -> str:
    """Return the tables ``driver`` and ``signals`` of the machine at ``place`` on a bus."""
    lines = [
        f'{name} = {{ id = "0x{first + place:X}", start = {bit}, length = {BITS}, signed = true,'
        f' scale = {SCALES[name]!r}, unit = "{UNITS[name]}" }}'
        for name, (first, bit) in PDOS.items()
    ]
    identifiers = {"command": f"0x{0x180 + place:X}", "feedback": f"0x{0x280 + place:X}"}
    return DRIVER.format(group=group(bus), port=port, counter=COUNTER, signals="\n".join(lines), **identifiers)


@contextmanager
def sending(port: int, rate: int, buses: Sequence[Sequence[Path]]) -> Iterator[None]:
    """Send from another process; ``buses`` has the record of each machine on each bus."""
    places = [f"{bus}:{path}" for bus, machines in enumerate(buses) for path in machines]
    command = [sys.executable, "-m", "benchmarks.hall_buses", str(port), str(rate), *places]
    with subprocess.Popen(command) as process:  # noqa: S603 - our own command
        try:
            yield
        finally:
            process.terminate()


def frames_of(path: Path) -> list[tuple[bytes, bytes]]:
    """Return the data of both frames of each row of a record, without their counters."""
    with path.open(newline="", encoding="utf-8") as stream:
        return [(_data(row, 0x180), _data(row, 0x280)) for row in csv.DictReader(stream)]


def _data(row: Mapping[str, str], first: int) -> bytes:
    values = [
        round(float(row[name]) / SCALES[name]).to_bytes(BITS // 8, "little", signed=True)
        for name, (identifier, _) in PDOS.items()
        if identifier == first
    ]
    return b"".join(values)


def send(port: int, rate: int, places: Sequence[tuple[int, Path]]) -> None:
    """Send the frames of all machines for ever."""
    records = {path: frames_of(path) for path in {path for _, path in places}}
    buses = {bus: open_bus(BusOptions(interface="udp_multicast", channel=group(bus), port=port)) for bus, _ in places}
    machines, counts = list[tuple[can.BusABC, int, list[tuple[bytes, bytes]]]](), dict.fromkeys(buses, 0)
    for bus, path in places:
        machines.append((buses[bus], counts[bus], records[path]))
        counts[bus] += 1
    begun, step = time.monotonic(), 0
    while True:
        row, part = divmod(step, SLICES)
        for line, place, frames in machines[part::SLICES]:
            for first, data in zip((0x180, 0x280), frames[row % len(frames)], strict=True):
                content = data + bytes([row % 256, 0])
                line.send(can.Message(arbitration_id=first + place, data=content, is_extended_id=False))
        step += 1
        time.sleep(max(0.0, begun + step / (rate * SLICES) - time.monotonic()))


if __name__ == "__main__":
    ONES = [argument.split(":", 1) for argument in sys.argv[3:]]
    send(int(sys.argv[1]), int(sys.argv[2]), [(int(bus), Path(path)) for bus, path in ONES])
