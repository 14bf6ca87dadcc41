"""The Modbus driver on a serial line, whose replies do not name their request; the device is a thread."""

import os
import pty
import select
import struct
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymodbus.framer.rtu import FramerRTU

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.modbus.driver import ModbusPoller, Options, Source, build
from tests.waiting import wait_for, within

REGISTERS = {"a": 1000, "b": 2000}
TIMEOUT = 0.2  # s


class Device:
    """Registers hold their own addresses; ``delay`` returns the s from a request to its reply, None for no reply."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        self.delay: Callable[[int], float | None] = lambda number: 0.0
        self.requests = 0
        self.echo: Callable[[int], bool] = lambda number: False
        self.corrupt: Callable[[bytes], bytes] = lambda reply: reply
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="device")
        self._thread.start()

    def close(self) -> None:
        self._end.set()
        self._thread.join(5.0)
        os.close(self.master)
        os.close(self.slave)

    def _serve(self) -> None:
        received, replies = b"", list[tuple[float, bytes]]()
        while not self._end.is_set():
            if select.select([self.master], [], [], 0.002)[0]:
                received += os.read(self.master, 256)
            if len(received) >= 8:
                request, received = received[:8], received[8:]
                self.requests += 1
                if self.echo(self.requests):
                    replies.append((time.monotonic(), request))
                if (delay := self.delay(self.requests)) is not None:
                    replies.append((time.monotonic() + delay, self.corrupt(reply_to(request))))
            for due in [reply for reply in replies if reply[0] <= time.monotonic()]:
                os.write(self.master, due[1])
                replies.remove(due)


def with_checksum(body: bytes) -> bytes:
    return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")


def reply_to(request: bytes) -> bytes:
    number, function, address, count = struct.unpack(">BBHH", request[:6])
    body = bytes([number, function, 2 * count]) + struct.pack(f">{count}H", *range(address, address + count))
    return with_checksum(body)


@pytest.fixture
def device() -> Iterator[Device]:
    device = Device()
    try:
        yield device
    finally:
        device.close()


def poller(device: Device, timeout: float = TIMEOUT) -> ModbusPoller:
    """A driver with even parity, the default of Modbus."""
    signals = tuple(
        Signal(name, "V", Source.model_validate({"register": address, "type": "int16", "unit": "V"}))
        for name, address in REGISTERS.items()
    )
    options = Options(serial=os.ttyname(device.slave), baudrate=115200, timeout=f"{timeout} s")
    return build(options, Setup(signals, Path(), 0.01))


def test_late_reply_is_not_taken_for_the_next_one(device: Device) -> None:
    device.delay = lambda number: 1.5 * TIMEOUT if number % 20 == 0 else 0.0
    driver, samples = poller(device), list[Sample]()
    driver.open(samples.extend)
    try:
        wait_for(lambda: device.requests > 100)
    finally:
        driver.close()
    assert driver.counters().lost > 0
    assert {(sample.signal, sample.value) for sample in samples} == set(REGISTERS.items())


def test_echo_of_the_request_is_no_answer(device: Device) -> None:
    """The request for register 1000 alone is a valid reply of -6144."""
    device.echo = lambda number: number % 2 == 0
    device.delay = lambda number: None if number % 20 == 0 else 0.0
    driver, samples = poller(device), list[Sample]()
    driver.open(samples.extend)
    try:
        wait_for(lambda: device.requests > 100)
    finally:
        driver.close()
    assert len(samples) > 50
    assert {(sample.signal, sample.value) for sample in samples} == set(REGISTERS.items())


@pytest.mark.parametrize(
    "around",
    [
        (b"\0", b""),
        (b"\xff\xff", b""),
        (b"\x01", b""),
        (b"\x01\x03", b"\x01\x03"),
        (b"", b"\0"),
        (with_checksum(bytes([7, 3, 2, 0, 5])), b""),
        (bytes(range(40)), b"\xff"),
    ],
)
def test_the_answer_is_found_among_other_bytes(device: Device, around: tuple[bytes, bytes]) -> None:
    """An RS-485 adapter adds a byte when its driver is switched, and other devices answer others; no reading is lost.

    Without and with the echo of the request, before which such a byte may come, too.
    """
    device.corrupt = lambda reply: reply.join(around)
    device.echo = lambda number: number % 2 == 0
    driver, samples = poller(device), list[Sample]()
    driver.open(samples.extend)
    try:
        wait_for(lambda: device.requests > 50)
        assert driver.link().up
        assert not driver.link().warnings
    finally:
        driver.close()
    assert {(sample.signal, sample.value) for sample in samples} == set(REGISTERS.items())


@pytest.mark.parametrize(
    ("corrupt", "said"),
    [
        (lambda reply: reply[:-1] + bytes([reply[-1] ^ 1]), "wrong checksum"),
        (lambda reply: reply[:-3], "cut"),
        (lambda _: with_checksum(bytes([7, 3, 2, 0, 5])), "device 7 instead of 1"),
        (lambda _: with_checksum(bytes([1, 3, 4, 0, 5, 0, 5])), "4 bytes instead of 2"),
        (lambda _: b"\x93\x11\x80\x80", "are baudrate, parity and stop_bits"),
        (lambda _: b"", "no answer within"),
    ],
)
def test_what_is_no_answer_has_a_named_cause(device: Device, corrupt: Callable[[bytes], bytes], said: str) -> None:
    device.corrupt = corrupt
    driver, samples = poller(device), list[Sample]()
    driver.open(samples.extend)
    try:
        wait_for(lambda: any(said in line for line in driver.link().warnings))
    finally:
        driver.close()
    assert samples == []


def test_an_echo_without_an_answer_is_named(device: Device) -> None:
    device.echo, device.delay = lambda number: True, lambda number: None
    driver = poller(device)
    driver.open(lambda _: None)
    try:
        wait_for(lambda: any("only the echo" in line for line in driver.link().warnings))
    finally:
        driver.close()


def test_silent_line_is_reopened(device: Device) -> None:
    """A pseudo-terminal rejects a parity the second time."""
    driver, samples = poller(device), list[Sample]()
    driver.open(samples.extend)
    try:
        wait_for(lambda: len(samples) > 10)
        device.delay = lambda number: None
        wait_for(lambda: not driver.link().up)
        device.delay = lambda number: 0.0
        wait_for(lambda: driver.link().up)
    finally:
        driver.close()
    assert driver.counters().reconnects == 1


def test_wall_clock_set_back_does_not_block_the_line(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, samples, wall = poller(device), list[Sample](), time.time
    driver.open(samples.extend)
    try:
        wait_for(lambda: len(samples) > 10)
        device.delay = lambda number: None
        requests = device.requests
        wait_for(lambda: device.requests > requests)
        monkeypatch.setattr(time, "time", lambda: wall() - 3600.0)
        wait_for(lambda: not driver.link().up)
    finally:
        driver.close()


@pytest.mark.timed
def test_slow_device_does_not_delay_close(device: Device) -> None:
    device.delay = lambda number: None
    driver = poller(device, 10.0)
    driver.open(lambda _: None)
    wait_for(lambda: device.requests > 0)
    begun = time.monotonic()
    driver.close()
    assert time.monotonic() - begun < within(1.0)
    assert not [thread for thread in threading.enumerate() if thread.name == "modbus-poll"]


def test_termios_error_is_reported_and_retried(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """An adapter is unplugged while it is opened: the library raises what is no OSError."""

    def unplugged(*_: object) -> None:
        raise termios.error(5, "Input/output error")

    driver = poller(device)
    with monkeypatch.context() as broken:
        broken.setattr("termios.tcsetattr", unplugged)
        driver.open(lambda _: None)
        wait_for(lambda: driver.link().reason == "Input/output error")
    try:
        wait_for(lambda: driver.link().up)
    finally:
        driver.close()
