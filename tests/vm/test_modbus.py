"""Our Modbus driver against a server made with libmodbus, in C, over TCP and over a serial line.

Runs on the host; the server's own record says which function codes were sent.
"""

import json
import os
import select
import shutil
import socket
import subprocess
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from otolith_drivers.base import Setup, Signal
from otolith_drivers.modbus.driver import Options, Source, build
from tests.conftest import free_port
from tests.drivers.modbus_readers import Listener
from tests.waiting import wait_for

SERVER = Path(__file__).with_name("modbus_server.c")
FLAGS = ("-std=c11", "-D_DEFAULT_SOURCE", "-O1", "-Wall", "-Wextra", "-Werror")
PERIOD = 0.02  # s
BAUDRATE = 115200

# What the server has, by signal; that which moves has no value here.
MOVING = {
    "standard": {"register": 0, "type": "float32"},
    "words_swapped": {"register": 2, "type": "float32", "order": "CDAB"},
    "bytes_swapped": {"register": 4, "type": "float32", "order": "BADC"},
    "both_swapped": {"register": 6, "type": "float32", "order": "DCBA"},
}
STANDING: dict[str, tuple[dict[str, object], float]] = {
    "int32": ({"register": 10, "type": "int32"}, -1234567.0),
    "int32_swapped": ({"register": 12, "type": "int32", "order": "CDAB", "scale": 0.001}, -1234.567),
    "uint32": ({"register": 14, "type": "uint32"}, 4123456789.0),
    "int64": ({"register": 16, "type": "int64"}, -9007199254740991.0),
    "uint64": ({"register": 20, "type": "uint64", "order": "DCBA"}, 9007199254740991.0),
    "float64": ({"register": 24, "type": "float64"}, -0.1),
    "float64_swapped": ({"register": 28, "type": "float64", "order": "CDAB"}, -0.1),
    "bit": ({"register": 32, "type": "uint16", "bits": "15"}, 1.0),
    "bits": ({"register": 32, "type": "uint16", "bits": "4..7"}, 12.0),
    "int16": ({"register": 10, "table": "input", "type": "int16", "scale": 0.001, "offset": 1.0}, -0.5),
    "uint16": ({"register": 11, "table": "input", "type": "uint16"}, 64000.0),
    "input_float": ({"register": 12, "table": "input", "type": "float32"}, -273.15),
}
COUNTER = {"register": 8, "type": "uint16"}
ABSENT = {"register": 63, "type": "float32"}  # its second half is beyond the last register
EVERYTHING = {**MOVING, **{name: keys for name, (keys, _) in STANDING.items()}, "counter": COUNTER}


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program, compiled."""
    compiler = shutil.which("gcc")
    assert compiler is not None, "apt install gcc libc6-dev libmodbus-dev"
    program = tmp_path_factory.mktemp("modbus") / "modbus_server"
    subprocess.run([compiler, *FLAGS, "-o", str(program), str(SERVER), "-lmodbus"], check=True)
    return program


class Cable:
    """A serial line: two pseudo-terminals, and a thread that carries bytes from each to the other."""

    def __init__(self) -> None:
        pairs = [os.openpty() for _ in range(2)]
        self._ends = [pair[0] for pair in pairs]
        self._open = [descriptor for pair in pairs for descriptor in pair]
        for _, terminal in pairs:
            tty.setraw(terminal)
        self.names = [os.ttyname(terminal) for _, terminal in pairs]
        self.spoil: Callable[[bytes], bytes] = lambda data: data
        """What happens to bytes on their way from the first end to the second."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._carry, name="cable")
        self._thread.start()

    def _carry(self) -> None:
        first, second = self._ends
        while not self._stop.is_set():
            for end in select.select(self._ends, [], [], 0.05)[0]:
                data = os.read(end, 4096)
                os.write(second if end == first else first, self.spoil(data) if end == first else data)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for descriptor in self._open:
            os.close(descriptor)


@dataclass
class Serving:
    """The server's process."""

    process: "subprocess.Popen[str]"

    def stop(self) -> dict[str, dict[str, int] | int]:
        """What it says in the end."""
        self.process.terminate()
        output, _ = self.process.communicate(timeout=10)
        assert self.process.returncode == 0
        said: dict[str, dict[str, int] | int] = json.loads(output.splitlines()[-1])
        return said


@contextmanager
def serving(server: Path, *arguments: str) -> Iterator[Serving]:
    process = subprocess.Popen([str(server), *arguments], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "serving\n"
    try:
        yield Serving(process)
    finally:
        process.kill()
        process.wait(timeout=10)
        process.stdout.close()


@dataclass
class Line:
    """Where the server is to be, and where the driver finds it."""

    arguments: tuple[str, ...]
    options: dict[str, object]
    cable: Cable | None = None


@pytest.fixture(params=["tcp", "rtu"])
def line(request: pytest.FixtureRequest) -> Iterator[Line]:
    if request.param == "tcp":
        port = free_port(socket.SOCK_STREAM)
        yield Line(("tcp", str(port)), {"host": "127.0.0.1", "port": port})
        return
    cable = Cable()
    options: dict[str, object] = {"serial": cable.names[1], "baudrate": BAUDRATE, "parity": "N", "stop_bits": 1}
    yield Line(("rtu", cable.names[0], str(BAUDRATE)), options, cable)
    cable.close()


class Reading(Listener):
    """What is read of a line."""

    def __init__(self, line: Line, sources: dict[str, dict[str, object]]) -> None:
        signals = tuple(
            Signal(name, "V", Source.model_validate({"unit": "V", **keys})) for name, keys in sources.items()
        )
        options = Options.model_validate({"device": 1, "timeout": "0.2 s", **line.options})
        super().__init__(build(options, Setup(signals, Path(), PERIOD)))

    def values(self, name: str) -> list[float]:
        return [sample.value for sample in self.of(name)]

    def until(self, condition: Callable[[], bool]) -> None:
        wait_for(condition, 20.0)

    def wait_for_more(self, name: str, count: int = 50) -> None:
        before = len(self.of(name))
        self.until(lambda: len(self.of(name)) >= before + count)


def only_reads(said: dict[str, dict[str, int] | int], *codes: str) -> None:
    asked = said["asked"]
    assert isinstance(asked, dict)
    print(f"function codes that the server was sent: {asked}")
    assert set(asked) == set(codes)
    assert said["changed"] == 0


def test_every_type_and_order_is_read_and_nothing_is_written(server: Path, line: Line) -> None:
    with serving(server, *line.arguments) as serves, Reading(line, EVERYTHING) as listener:
        listener.wait_for_more("counter", 100)
        listener.driver.close()
        only_reads(serves.stop(), "3", "4")
    assert listener.driver.link().warnings == ()
    for name, (_, value) in STANDING.items():
        found = set(listener.values(name))
        assert len(found) == 1, name
        assert found.pop() == pytest.approx(value, rel=1e-7), name
    standard = listener.values("standard")
    assert len(set(standard)) > 20  # it moves
    assert {24.0 <= value < 25.0 for value in standard} == {True}
    for name in MOVING:
        assert listener.values(name) == standard, name
    counted = listener.values("counter")
    assert counted == sorted(set(counted))  # every reading is a new one, in order
    counters = listener.driver.counters()
    assert (counters.bad, counters.reconnects) == (0, 0)
    assert counters.received == len(listener.samples)


def test_a_register_that_the_server_does_not_have_costs_only_itself(server: Path, line: Line) -> None:
    sources = {"standard": MOVING["standard"], "counter": COUNTER, "absent": ABSENT}
    with serving(server, *line.arguments) as serves, Reading(line, sources) as listener:
        listener.until(lambda: any("illegal data address" in line for line in listener.driver.link().warnings))
        listener.wait_for_more("standard")
        assert listener.driver.link().up
        assert not listener.values("absent")
        listener.driver.close()
        only_reads(serves.stop(), "3")


def test_a_server_that_goes_away_is_found_again(server: Path, line: Line) -> None:
    with Reading(line, {"standard": MOVING["standard"], "counter": COUNTER}) as listener:
        with serving(server, *line.arguments) as serves:
            listener.wait_for_more("counter")
            only_reads(serves.stop(), "3")
        listener.until(lambda: not listener.driver.link().up)
        assert listener.driver.link().reason
        with serving(server, *line.arguments) as serves:
            begun = time.monotonic()
            listener.until(lambda: listener.driver.link().up)
            print(f"found again after {time.monotonic() - begun:.2f} s")
            listener.wait_for_more("counter")
            listener.driver.close()
            only_reads(serves.stop(), "3")
    counters = listener.driver.counters()
    assert counters.reconnects == 1
    assert counters.lost > 0
    assert {24.0 <= value < 25.0 for value in listener.values("standard")} == {True}


@pytest.mark.parametrize("line", ["rtu"], indirect=True)
def test_no_byte_that_is_spoiled_on_the_line_becomes_a_reading(server: Path, line: Line) -> None:
    """The check sum is libmodbus' own."""
    assert line.cable is not None
    with serving(server, *line.arguments), Reading(line, {"standard": MOVING["standard"]}) as listener:
        listener.wait_for_more("standard")
        line.cable.spoil = lambda data: bytes([*data[:4], data[4] ^ 0x10, *data[5:]]) if len(data) > 5 else data
        lost = listener.driver.counters().lost
        listener.until(lambda: listener.driver.counters().lost >= lost + 5)
        line.cable.spoil = lambda data: data
        listener.wait_for_more("standard")
    assert {24.0 <= value < 25.0 for value in listener.values("standard")} == {True}
