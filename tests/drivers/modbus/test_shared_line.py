"""Many devices on one line: each is read at its fair rate, and one that is silent holds the others up for a moment."""

import os
import select
import socket
import struct
import threading
import time
import tty
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from otolith_drivers.base import Setup, Signal
from otolith_drivers.common.sharing import places
from otolith_drivers.modbus.driver import Options, Source, build
from tests.conftest import free_port
from tests.drivers.modbus_readers import Listener, floats, poller, source
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.drivers.serial_devices import _checksum
from tests.variants import often
from tests.waiting import wait_for

DEVICES = 20
SILENT = 7  # device number
PERIOD = 0.01  # s asked for; a line of 20 devices is too slow for it
TIMEOUT = 0.1  # s


@contextmanager
def line_of(devices: int, silent: int | None, delay: float = 0.002) -> Iterator[tuple[str, Counter[int]]]:
    """A pseudo-terminal with so many devices, of which one may be silent; yields its path and counts of requests."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    done, asked = threading.Event(), Counter[int]()

    def serve() -> None:
        while not done.is_set():
            if not select.select([ours], [], [], 0.05)[0]:
                continue
            request = os.read(ours, 8)
            device, function, address, count = struct.unpack(">BBHH", request[:6])
            asked[device] += 1
            if device == silent or not 1 <= device <= devices:
                continue
            time.sleep(delay)  # the time of its bytes
            words = floats(float(device))
            reply = bytes([device, function, 2 * count]) + struct.pack(
                f">{count}H", *(words.get(at, 0) for at in range(address, address + count))
            )
            os.write(ours, reply + _checksum(reply))

    thread = threading.Thread(target=serve, name="serial-line")
    thread.start()
    try:
        yield os.ttyname(theirs), asked
    finally:
        done.set()
        thread.join(5.0)
        os.close(ours)
        os.close(theirs)


def pump(path: str, device: int, **options: object) -> Listener:
    """A driver of one of the devices, which other drivers do not know."""
    keys = {"serial": path, "device": device, "timeout": f"{TIMEOUT} s", "baudrate": 115200, **options}
    signal = Signal("p", "V", Source.model_validate({"register": 0, "type": "float32", "unit": "V"}))
    return Listener(build(Options.model_validate(keys), Setup((signal,), Path(), PERIOD)))


def test_two_spellings_of_a_port_are_one_line(tmp_path: Path) -> None:
    with line_of(2, None) as (path, _), ExitStack() as stack:
        (tmp_path / "line").symlink_to(path)
        pumps = [stack.enter_context(pump(str(port), number)) for number, port in ((1, path), (2, tmp_path / "line"))]
        wait_for(lambda: all(len(each.samples) >= 5 for each in pumps))
        assert len(places()) == 1
    assert not places()


def test_twenty_devices_on_a_line_are_read_at_the_same_rate() -> None:
    with line_of(DEVICES, None) as (path, _), ExitStack() as stack:
        pumps = [stack.enter_context(pump(path, device)) for device in range(1, DEVICES + 1)]
        wait_for(lambda: all(len(each.samples) >= 30 for each in pumps))
        counts = [len(each.samples) for each in pumps]
        assert {sample.value for sample in pumps[4].samples} == {5.0}
    assert max(counts) <= 1.5 * min(counts)
    assert not places()


def test_a_silent_device_is_down_alone_and_holds_the_others_up_for_its_timeouts_only() -> None:
    with line_of(DEVICES, SILENT) as (path, asked), ExitStack() as stack:
        pumps = {device: stack.enter_context(pump(path, device)) for device in range(1, DEVICES + 1)}
        pumps[SILENT].wait(lambda link: not link.up and "no device answers" in link.reason)
        before = {device: len(each.samples) for device, each in pumps.items()}
        tries, begun = asked[SILENT], time.monotonic()
        others = [device for device in pumps if device != SILENT]
        wait_for(lambda: all(len(pumps[device].samples) - before[device] >= 20 for device in others))
        tries, elapsed = asked[SILENT] - tries, time.monotonic() - begun
        for device, each in pumps.items():
            assert each.driver.link().up == (device != SILENT), device
        gaps = [
            later.time - earlier.time
            for device, each in pumps.items()
            for earlier, later in zip(each.samples[-20:], each.samples[-19:], strict=False)
            if device != SILENT
        ]
    assert len(pumps[SILENT].samples) == 0
    assert tries * 2 * TIMEOUT < elapsed  # its time-out, and as long until the line is silent
    assert sorted(gaps)[len(gaps) // 2] < 2 * TIMEOUT


def test_the_last_driver_closes_the_line_and_others_go_on() -> None:
    with line_of(2, None) as (path, _):
        with pump(path, 1) as first:
            with pump(path, 2) as second:
                wait_for(lambda: len(first.samples) > 3 and len(second.samples) > 3)
            count = len(first.samples)
            wait_for(lambda: len(first.samples) > count + 3)
        with pump(path, 2) as again:
            wait_for(lambda: len(again.samples) > 3)


def test_a_driver_with_other_options_of_the_line_says_so_and_harms_nobody() -> None:
    with line_of(2, None) as (path, _), pump(path, 1) as first, pump(path, 2, baudrate=9600) as second:
        second.wait(lambda link: "baudrate 115200 there and 9600 here" in link.reason)
        count = len(first.samples)
        wait_for(lambda: len(first.samples) > count + 3)
        assert not second.samples


@pytest.mark.parametrize("drives", often([5], [5, 30]))
def test_drives_behind_a_gateway_share_one_connection_and_one_is_silent(drives: int) -> None:
    behaviour = Behaviour(floats(1.0), silent=lambda device: device == 2)
    with odd_server(behaviour, port := free_port(socket.SOCK_STREAM)), ExitStack() as stack:
        numbers = range(1, drives + 1)
        read = {n: stack.enter_context(Listener(poller(port, [source(register=0)], device=n))) for n in numbers}
        read[2].wait(lambda link: not link.up and "no device answers" in link.reason)
        wait_for(lambda: all(len(drive.samples) > 5 for number, drive in read.items() if number != 2))
        assert len(places()) == 1
        assert [number for number, drive in read.items() if not drive.driver.link().up] == [2]
