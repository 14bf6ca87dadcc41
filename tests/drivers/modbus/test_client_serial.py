"""The Modbus driver on a serial line, where no reply tells which question it answers; the device is a thread."""

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
    """Whose registers hold their own addresses. ``delay`` gives of each question the s until its answer, if any."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        self.delay: Callable[[int], float | None] = lambda question: 0.0
        self.questions = 0
        self.echo: Callable[[int], bool] = lambda question: False
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="device")
        self._thread.start()

    def close(self) -> None:
        self._end.set()
        self._thread.join(5.0)
        os.close(self.master)
        os.close(self.slave)

    def _serve(self) -> None:
        asked, answers = b"", list[tuple[float, bytes]]()
        while not self._end.is_set():
            if select.select([self.master], [], [], 0.002)[0]:
                asked += os.read(self.master, 256)
            if len(asked) >= 8:
                question, asked = asked[:8], asked[8:]
                self.questions += 1
                if self.echo(self.questions):
                    answers.append((time.monotonic(), question))
                if (delay := self.delay(self.questions)) is not None:
                    answers.append((time.monotonic() + delay, answer(question)))
            for due in [entry for entry in answers if entry[0] <= time.monotonic()]:
                os.write(self.master, due[1])
                answers.remove(due)


def answer(question: bytes) -> bytes:
    number, function, address, count = struct.unpack(">BBHH", question[:6])
    body = bytes([number, function, 2 * count]) + struct.pack(f">{count}H", *range(address, address + count))
    return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")


@pytest.fixture
def device() -> Iterator[Device]:
    found = Device()
    try:
        yield found
    finally:
        found.close()


def poller(device: Device, timeout: float = TIMEOUT) -> ModbusPoller:
    """Even parity, as Modbus has it unless said."""
    signals = tuple(
        Signal(name, "V", Source.model_validate({"register": address, "type": "int16", "unit": "V"}))
        for name, address in REGISTERS.items()
    )
    options = Options(serial=os.ttyname(device.slave), baudrate=115200, timeout=f"{timeout} s")
    return build(options, Setup(signals, Path(), 0.01))


def test_a_late_reply_is_not_taken_for_the_next_one_of_the_same_size(device: Device) -> None:
    device.delay = lambda question: 1.5 * TIMEOUT if question % 20 == 0 else 0.0
    driver, samples = poller(device), list[Sample]()
    driver.open(samples.extend)
    try:
        wait_for(lambda: device.questions > 100)
    finally:
        driver.close()
    assert driver.counters().lost > 0
    assert {(sample.signal, sample.value) for sample in samples} == set(REGISTERS.items())


def test_what_an_adapter_hears_of_itself_is_no_answer(device: Device) -> None:
    """The question for register 1000 alone reads like an answer of -6144."""
    device.echo = lambda question: question % 2 == 0
    device.delay = lambda question: None if question % 20 == 0 else 0.0
    driver, samples = poller(device), list[Sample]()
    driver.open(samples.extend)
    try:
        wait_for(lambda: device.questions > 100)
    finally:
        driver.close()
    assert len(samples) > 50
    assert {(sample.signal, sample.value) for sample in samples} == set(REGISTERS.items())


def test_a_silent_line_is_opened_again_and_heard_again(device: Device) -> None:
    """A pseudo-terminal refuses its parity the second time."""
    driver, samples = poller(device), list[Sample]()
    driver.open(samples.extend)
    try:
        wait_for(lambda: len(samples) > 10)
        device.delay = lambda question: None
        wait_for(lambda: not driver.link().up)
        device.delay = lambda question: 0.0
        wait_for(lambda: driver.link().up)
    finally:
        driver.close()
    assert driver.counters().reconnects == 1


def test_a_clock_that_is_set_back_does_not_hold_up_the_line(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, samples, wall = poller(device), list[Sample](), time.time
    driver.open(samples.extend)
    try:
        wait_for(lambda: len(samples) > 10)
        device.delay = lambda question: None
        asked = device.questions
        wait_for(lambda: device.questions > asked)
        monkeypatch.setattr(time, "time", lambda: wall() - 3600.0)
        wait_for(lambda: not driver.link().up)
    finally:
        driver.close()


@pytest.mark.timed
def test_a_slow_device_does_not_delay_the_end(device: Device) -> None:
    device.delay = lambda question: None
    driver = poller(device, 10.0)
    driver.open(lambda _: None)
    wait_for(lambda: device.questions > 0)
    begun = time.monotonic()
    driver.close()
    assert time.monotonic() - begun < within(1.0)
    assert not [thread for thread in threading.enumerate() if thread.name == "modbus-poll"]


def test_what_a_port_refuses_is_told_and_tried_again(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """An adapter that is pulled out while it is opened: the library lets through what is no OSError."""

    def pulled_out(*_: object) -> None:
        raise termios.error(5, "Input/output error")

    driver = poller(device)
    with monkeypatch.context() as broken:
        broken.setattr("termios.tcsetattr", pulled_out)
        driver.open(lambda _: None)
        wait_for(lambda: driver.link().reason == "Input/output error")
    try:
        wait_for(lambda: driver.link().up)
    finally:
        driver.close()
