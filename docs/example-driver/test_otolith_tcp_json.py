"""The example driver keeps the contract of all drivers and reconnects. Run with pytest in this folder."""

import json
import math
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import otolith_tcp_json
import pytest

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.conformance import CONTRACT, Rig

READING = json.dumps({"speed": 60.0, "current": 500.0}).encode() + b"\n"
EXPECTED = {"omega": 2.0 * math.pi, "i": 0.5}
BAD_LINES = (b"", b"\xff\xfe", b"[]", b"{}", b"[" * 4000, b'{"speed": 1%s}' % (b"0" * 400))


class Device(socketserver.ThreadingTCPServer):
    """The device: what is sent goes to each client that is connected."""

    allow_reuse_address = daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), socketserver.BaseRequestHandler)
        self.clients: list[socket.socket] = []
        self.port = int(self.server_address[1])

    def finish_request(self, request: object, _: object) -> None:
        assert isinstance(request, socket.socket)
        self.clients.append(request)
        with suppress(OSError):
            while request.recv(1):
                pass

    def emit(self, data: bytes = READING) -> None:
        for client in list(self.clients):
            with suppress(OSError):
                client.sendall(data)


@contextmanager
def device(port: int = 0) -> Iterator[Device]:
    with Device(port) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
            for client in server.clients:
                with suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)


def build_driver(port: int) -> otolith_tcp_json.TcpJson:
    signals = (
        Signal("omega", "rad/s", otolith_tcp_json.Source(key="speed", unit="rpm")),
        Signal("i", "A", otolith_tcp_json.Source(key="current", unit="mA")),
    )
    options = otolith_tcp_json.Options(host="127.0.0.1", port=port)
    return otolith_tcp_json.build(options, Setup(signals, Path(), 0.01))


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy computer the device of a test may be silent for longer than a real one."""
    monkeypatch.setattr(otolith_tcp_json, "SILENCE_TIMEOUT", 60.0)


@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_the_driver_keeps_the_contract(check: Callable[[Rig], None]) -> None:
    with device() as source:
        driver = build_driver(source.port)
        check(Rig(driver, EXPECTED, source.emit))
        driver.close()


def test_a_device_that_restarts_is_connected_again_and_half_a_line_is_dropped() -> None:
    samples: list[Sample] = []
    with device() as source:
        driver = build_driver(source.port)
        driver.open(samples.extend)
        wait_for(lambda: bool(source.clients))
        source.emit(READING + READING[:10])
        wait_for(lambda: len(samples) == 2)
    try:
        wait_for(lambda: not driver.link().up)
        assert driver.link().reason
        with device(source.port) as source:
            wait_for(lambda: bool(source.clients))
            source.emit()
            wait_for(lambda: len(samples) == 4)
            assert driver.link().up
    finally:
        driver.close()
    assert (driver.counters().received, driver.counters().bad, driver.counters().reconnects) == (4, 0, 1)
    assert {sample.signal: sample.value for sample in samples} == pytest.approx(EXPECTED)


def test_no_line_ends_the_thread() -> None:
    with device() as source:
        driver = build_driver(source.port)
        driver.open(lambda samples: None)
        try:
            wait_for(lambda: bool(source.clients))
            source.emit(b"\n".join(BAD_LINES) + b"\n" + READING)
            wait_for(lambda: driver.counters().received == 2)
            assert driver.counters().bad == len(BAD_LINES)
            source.emit(b"x" * 2 * otolith_tcp_json.MAX_LINE)
            wait_for(lambda: not driver.link().up)
        finally:
            driver.close()
