"""The receiver on real buses between processes: reconnects, warnings, counters, and that it never sends."""

import ast
import os
import pty
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import pytest
from msgpack import packb as pack

from otolith_drivers.base import Sample, Setup
from otolith_drivers.canbus import driver as can_receiver
from otolith_drivers.canbus.bus import BusOptions, enlarge_buffer, frames_dropped, open_bus
from otolith_drivers.canbus.driver import CanOptions, CanReceiver, build
from tests.conftest import OwnMachine, free_port
from tests.drivers.can_frames import frame, signals
from tests.waiting import PATIENCE

RAW = {"V_a": ("V", {"id": "0x181", "start": 0, "length": 16, "signed": True, "scale": 0.01, "unit": "V"})}
COUNTED: dict[str, Any] = {"0x181": {"counter": {"start": 56, "length": 8}, "period": "10 ms"}}
SENDER = """
import sys, time, can
interface, channel, port, count, fd = sys.argv[1:]
bus = can.Bus(interface=interface, channel=channel, port=int(port), hop_limit=0, fd=fd == "fd")
print("ready", flush=True)
sys.stdin.readline()
for index in range(int(count)):
    data = (index % 1000).to_bytes(2, "little") + bytes(5) + bytes([index % 256]) + bytes(56 if fd == "fd" else 0)
    bus.send(can.Message(arbitration_id=0x181, data=data, is_extended_id=False, is_fd=fd == "fd"))
    time.sleep(0.001)
bus.shutdown()
"""


def until(condition: Callable[[], bool], within: float = PATIENCE) -> bool:
    deadline = time.monotonic() + within
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    return condition()


def receiver(wishes: Any = None, **options: Any) -> CanReceiver:
    return build(CanOptions.model_validate(options), Setup(signals(wishes or RAW), Path(), 0.01))


@pytest.fixture
def bus_options(own_machine: OwnMachine) -> dict[str, Any]:
    return {"interface": "udp_multicast", "channel": own_machine.group, "port": own_machine.port}


@pytest.fixture
def opened(bus_options: dict[str, Any]) -> Iterator[tuple[CanReceiver, can.BusABC, list[Sample]]]:
    driver, bus, got = receiver(**bus_options), open_bus(BusOptions(**bus_options)), list[Sample]()
    driver.open(got.extend)
    yield driver, bus, got
    driver.close()
    bus.shutdown()


@pytest.mark.parametrize("kind", ["classic", "fd"])
def test_frames_of_another_process_arrive_complete(
    bus_options: dict[str, Any], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("MIN_SILENCE", "UNKNOWN_PERIOD_SILENCE"):  # a busy computer starts and ends the process slowly
        monkeypatch.setattr(f"otolith_drivers.canbus.channel.{limit}", PATIENCE)
    wishes = RAW if kind == "classic" else {"V_a": ("V", {**RAW["V_a"][1], "fd": True})}
    options = {**bus_options, "fd": kind == "fd", "messages": COUNTED}
    driver, got = receiver(wishes, **options), list[Sample]()
    arguments = ["udp_multicast", bus_options["channel"], str(bus_options["port"]), "500", kind]
    command = [sys.executable, "-c", SENDER, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as sender:
        assert sender.stdout is not None
        assert sender.stdout.readline() == "ready\n"  # a bus that is silent for long is opened again
        driver.open(got.extend)
        sender.communicate("\n", timeout=PATIENCE)
    assert until(lambda: len(got) == 500)
    driver.close()
    assert [round(sample.value * 100) for sample in got] == [index % 1000 for index in range(500)]
    assert all(one.time <= other.time for one, other in pairwise(got))
    assert (driver.counters().bad, driver.counters().reconnects) == (0, 0)


def test_data_bitrate_needs_fd(bus_options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="data_bitrate is that of CAN FD"):
        BusOptions(**bus_options, data_bitrate="2 Mbit/s")


def test_link_is_down_from_bus_off_to_the_next_frame(
    opened: tuple[CanReceiver, can.BusABC, list[Sample]],
) -> None:
    driver, bus, got = opened
    bus.send(can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True, is_extended_id=False))
    assert until(lambda: not driver.link().up)
    assert driver.link().reason.startswith("bus off")
    bus.send(frame(0x181, bytes(8)))
    assert until(lambda: driver.link().up)
    assert until(lambda: len(got) == 1)
    assert any("bus off" in line for line in driver.link().warnings)


def test_many_unreadable_frames_open_the_bus_anew(
    opened: tuple[CanReceiver, can.BusABC, list[Sample]], own_machine: OwnMachine
) -> None:
    driver, bus, got = opened
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for _ in range(60):
            stranger.sendto(b"\xc1 no frame", (own_machine.group, own_machine.port))
            time.sleep(0.001)
    assert until(lambda: driver.counters().reconnects >= 1)
    assert driver.counters().bad >= 51
    assert until(lambda: driver.link().up)
    bus.send(frame(0x181, bytes(8)))
    assert until(lambda: len(got) == 1)


def test_malformed_frames_do_not_end_the_thread(
    opened: tuple[CanReceiver, can.BusABC, list[Sample]], own_machine: OwnMachine
) -> None:
    """A frame with the right fields may have any value in them."""
    _, bus, got = opened
    fields = {
        "timestamp": 0.0,
        "arbitration_id": 0x181,
        "is_extended_id": False,
        "is_remote_frame": False,
        "is_error_frame": False,
        "channel": None,
        "dlc": 8,
        "data": bytes(8),
        "is_fd": False,
        "bitrate_switch": False,
        "error_state_indicator": False,
    }
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for key in fields:
            for value in (None, "text", -1, 1e400, [1], {"a": 1}, b""):
                stranger.sendto(pack({**fields, key: value}), (own_machine.group, own_machine.port))
                time.sleep(0.001)
    bus.send(frame(0x181, (1234).to_bytes(2, "little") + bytes(6)))
    assert until(lambda: any(sample.value == pytest.approx(12.34) for sample in got))
    assert all(isinstance(sample.time, float) and sample.value == sample.value for sample in got)


def test_link_has_the_warnings_of_the_decoder(bus_options: dict[str, Any]) -> None:
    driver = receiver(**bus_options, messages=COUNTED)
    driver.open(lambda _: None)
    assert driver.link().warnings == ()
    assert until(lambda: any("0x181 has not come once" in line for line in driver.link().warnings))
    driver.close()


class SocketCand(threading.Thread):
    """The part of socketcand that a client needs; ``silent`` is a server that lost its power."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self.silent, self.ended = threading.Event(), threading.Event()
        self.clients = 0
        self._server = socket.create_server(("127.0.0.1", port))
        self._server.settimeout(0.1)

    def run(self) -> None:
        served: list[socket.socket] = []
        while not self.ended.is_set():
            try:
                client = self._server.accept()[0]
            except TimeoutError:
                continue
            self.clients += 1
            served.append(client)
            threading.Thread(target=self._serve, args=(client, self.clients), daemon=True).start()
        for client in [*served, self._server]:
            client.close()

    def _serve(self, client: socket.socket, number: int) -> None:
        try:
            client.sendall(b"< hi >")
            for answer in (b"< ok >", b"< ok >"):
                client.recv(100)
                client.sendall(answer)
            index = 0
            while not self.ended.is_set() and not (self.silent.is_set() and number == 1):
                time.sleep(0.01)
                client.sendall(f"< frame 181 {time.time():.6f} {index % 100:02X}00 >".encode())
                index += 1
        except OSError:
            return


def test_a_silent_server_is_connected_anew() -> None:
    """python-can returns None for ever; the driver opens the bus anew."""
    port = free_port(socket.SOCK_STREAM)
    server = SocketCand(port)
    server.start()
    bus = can.Bus  # the interface takes a host, which our options need not know

    def opened(**arguments: Any) -> can.BusABC:
        return bus(interface="socketcand", channel="can0", host="127.0.0.1", port=port)

    driver, got = receiver(interface="socketcand", channel="can0"), list[Sample]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(can, "Bus", opened)
        driver.open(got.extend)
        assert until(lambda: len(got) > 50)
        server.silent.set()
        assert until(lambda: driver.counters().reconnects == 1)
        before = len(got)
        assert until(lambda: len(got) > before + 50)
        assert driver.link().up
        driver.close()
    server.ended.set()
    server.join(2.0)


def test_adapters_get_the_listen_only_command() -> None:
    """An slcan adapter has a command for it; no frame is written."""
    for listen_only, command in ((True, b"L\r"), (False, b"O\r")):
        master, slave = pty.openpty()
        options = BusOptions(interface="slcan", channel=os.ttyname(slave), listen_only=listen_only)
        bus = open_bus(options, listen_only=True)
        written = b""
        while command not in written:
            written += os.read(master, 100)
        before = len(list(Path("/proc/self/fd").iterdir()))
        enlarge_buffer(bus)
        assert frames_dropped(bus) is None
        assert len(list(Path("/proc/self/fd").iterdir())) == before
        bus.shutdown()
        os.close(master)
        os.close(slave)
        assert b"t" not in written


def test_no_code_of_the_package_sends() -> None:
    """No file of the driver names ``send`` or anything else that transmits; the node of the plant may."""
    folder = Path(can_receiver.__file__).parent
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
            assert not name.startswith(("send", "sdo", "nmt", "remote_request")), f"{path.name}: {name}"


def test_frames_that_the_kernel_drops_are_counted(bus_options: dict[str, Any]) -> None:
    options = BusOptions(**bus_options)
    with open_bus(options) as slow, open_bus(options) as sender:
        with socket.socket(fileno=os.dup(slow.fileno())) as handle:
            handle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        if frames_dropped(slow) is None:
            pytest.skip("this kernel does not tell what it drops")
        for _ in range(200):
            sender.send(frame(0x181, bytes(8)))
        got = 0
        while slow.recv(0.1) is not None:
            got += 1
        assert got < 200
        assert frames_dropped(slow) == 200 - got


def test_the_receive_buffer_is_enlarged(bus_options: dict[str, Any]) -> None:
    with open_bus(BusOptions(**bus_options)) as bus, socket.socket(fileno=os.dup(bus.fileno())) as handle:
        before = handle.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        enlarge_buffer(bus)
        assert handle.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= before
