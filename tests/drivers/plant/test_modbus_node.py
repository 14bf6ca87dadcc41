"""The simulated Modbus drive in a process of its own, read by the clients of pymodbus and by raw bytes."""

import asyncio
import math
import os
import select
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import psutil
import pytest
from pymodbus import ModbusException
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.pdu import ModbusPDU

from otolith_drivers.errors import DeviceError
from otolith_drivers.plant.modbus_node import _create_link
from otolith_drivers.plant.realtime import open_node, run_nodes
from otolith_drivers.plant.scenario import load_scenario
from tests.conftest import EXAMPLES
from tests.drivers.drives import COUNTER, REGISTERS, Client, Drive, floats, line_says, past, wait_for
from tests.waiting import PATIENCE
from tests.waiting import wait_for as wait_until


@pytest.mark.parametrize("transport", ["modbus-tcp", "modbus-rtu"])
def test_modbus_read_is_one_sample_of_the_scenario(drive: Callable[..., Drive], transport: str) -> None:
    """Holding and input registers, bit by bit of a float32, and never a mixture of two samples."""
    node, seen = drive("", transport), list[Sequence[int]]()
    with node.client() as client:
        while not seen or seen[-1][COUNTER] < 50:
            for read in (client.read_input_registers, client.read_holding_registers):
                seen.append(read(0, count=REGISTERS).registers)
        part = client.read_holding_registers(4, count=2)
        assert not part.isError()
        assert client.read_holding_registers(COUNTER, count=2).exception_code == 2
    ticks = node.ticks(seen[-1][COUNTER] + 1)
    for registers in seen:
        assert np.array_equal(floats(registers), np.array(ticks[registers[COUNTER]], np.float32))
    code, done = node.end()
    assert code == 0
    assert done["functions"] == {"3": len(seen) // 2 + 2, "4": len(seen) // 2}
    assert done["answers"] == len(seen) + 2
    assert f"{len(seen) + 2} answers to {len(seen) + 2} requests" in node.stderr
    assert not node.line.is_symlink()


def test_modbus_asynchronous_client_reads_the_same(drive: Callable[..., Drive]) -> None:
    node = drive()

    async def read() -> list[Sequence[int]]:
        client = AsyncModbusTcpClient("127.0.0.1", port=node.port, timeout=PATIENCE, retries=0)
        assert await client.connect()
        reads = [(await client.read_holding_registers(0, count=REGISTERS)).registers for _ in range(100)]
        client.close()
        return reads

    seen = asyncio.run(read())
    ticks = node.ticks(seen[-1][COUNTER] + 1)
    for registers in seen:
        assert np.array_equal(floats(registers), np.array(ticks[registers[COUNTER]], np.float32))


NO_READS: dict[int, Callable[[Client], ModbusPDU]] = {
    1: lambda client: client.read_coils(0, count=3),
    2: lambda client: client.read_discrete_inputs(0, count=3),
    5: lambda client: client.write_coil(0, value=True),
    6: lambda client: client.write_register(0, 7),
    8: lambda client: client.diag_query_data(b"ab"),
    15: lambda client: client.write_coils(0, [True, False]),
    16: lambda client: client.write_registers(0, [7, 7]),
    22: lambda client: client.mask_write_register(address=0, and_mask=0, or_mask=7),
    23: lambda client: client.readwrite_registers(read_address=0, read_count=2, write_address=0, values=[7]),
    43: lambda client: client.read_device_information(),
}


@pytest.mark.parametrize("transport", ["modbus-tcp", "modbus-rtu"])
def test_modbus_node_refuses_every_other_function(drive: Callable[..., Drive], transport: str) -> None:
    """Every function that does not read registers is illegal, counted, and without any effect."""
    node = drive("", transport)
    with node.client() as client:
        for function, ask in NO_READS.items():
            answer = ask(client)
            assert (answer.function_code, answer.exception_code) == (function | 0x80, 1)
        registers = client.read_holding_registers(0, count=REGISTERS).registers
    assert np.array_equal(floats(registers), np.array(node.ticks(registers[COUNTER] + 1)[-1], np.float32))
    _, done = node.end()
    assert done["refused"] == {str(function): 1 for function in NO_READS}


def test_modbus_tcp_refuses_another_device(drive: Callable[..., Drive]) -> None:
    node = drive("", "modbus-tcp", "device = 7")
    with node.client() as client:
        assert client.read_holding_registers(0, count=2, device_id=1).exception_code == 11
        assert not client.read_holding_registers(0, count=2, device_id=7).isError()


def test_modbus_rtu_ignores_another_device(drive: Callable[..., Drive]) -> None:
    node = drive("", "modbus-rtu", "device = 7")
    with node.client() as client:
        with pytest.raises(ModbusException, match="No response"):
            client.read_holding_registers(0, count=2, device_id=1)
        assert not client.read_holding_registers(0, count=2, device_id=7).isError()
    assert node.end()[1]["functions"] == {"3": 1}


REQUEST = bytes.fromhex("01 03 00 00 00 09 85 cc")  # nine registers from 0 on, with their checksum


@pytest.mark.parametrize("baudrate", [9600, 115200])
def test_serial_line_paces_bytes(drive: Callable[..., Drive], baudrate: int) -> None:
    """A read takes what both frames take; 9600 baud leave time for less than 30 reads of four signals per second."""
    node = drive("", "modbus-rtu", f"baudrate = {baudrate}")
    line = os.open(node.line, os.O_RDWR | os.O_NOCTTY)
    for _ in range(3):
        begun = time.monotonic()
        os.write(line, REQUEST)
        answer = line_says(line, 23)
        assert answer[:3] == b"\x01\x03\x12"
        assert time.monotonic() - begun >= (len(REQUEST) + len(answer)) * 10 / baudrate
    os.close(line)


def test_serial_line_noise_does_not_spoil_the_next_request(drive: Callable[..., Drive]) -> None:
    """A partial request is dropped after a silence, as Modbus RTU specifies."""
    node = drive("", "modbus-rtu")
    line = os.open(node.line, os.O_RDWR | os.O_NOCTTY)
    for rubbish in (REQUEST[:5], b"\xff\x00\xff", REQUEST[:-1] + b"\x00"):
        os.write(line, rubbish)
        assert not select.select([line], [], [], 0.2)[0]
        os.write(line, REQUEST)
        assert len(line_says(line, 23)) == 23
    os.close(line)


def test_modbus_node_survives_random_bytes(drive: Callable[..., Drive]) -> None:
    """What a stranger sends costs its own connection at most, and nothing of it is believed."""
    node, random = drive(), np.random.default_rng(7)
    for _ in range(100):
        header = b"\0\1\0\0\0" + random.bytes(1) if random.random() < 0.5 else b""
        with socket.create_connection(("127.0.0.1", node.port)) as stranger:
            stranger.sendall(header + random.bytes(int(random.integers(1, 300))))
    with node.client() as client:
        registers = wait_for(client, past(0)).registers
    assert np.array_equal(floats(registers), np.array(node.ticks(registers[COUNTER] + 1)[-1], np.float32))
    assert node.end()[0] == 0


@pytest.mark.parametrize(
    ("transport", "message"), [("modbus-tcp", "Address already in use"), ("modbus-rtu", "exists already")]
)
def test_second_modbus_node_is_refused_in_one_line(drive: Callable[..., Drive], transport: str, message: str) -> None:
    node = drive("", transport)
    second = subprocess.run(node.command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert second.returncode == 2
    assert len(second.stderr.splitlines()) == 1
    assert message in second.stderr
    assert "second plant running? Stop it" in second.stderr
    with node.client() as client:
        wait_for(client, past(0))


@pytest.mark.parametrize("transport", ["modbus-tcp", "modbus-rtu"])
def test_modbus_node_removes_its_link_on_ctrl_c(drive: Callable[..., Drive], transport: str) -> None:
    node = drive("", transport)
    with node.client() as client:
        wait_for(client, past(0))
        code, done = node.end(signal.SIGINT)
    assert code == 130
    assert done["ticks"] > 0
    assert not node.line.is_symlink()


def test_serial_line_replaces_the_link_of_a_killed_node(drive: Callable[..., Drive]) -> None:
    killed = drive("", "modbus-rtu")
    killed.close()
    assert killed.line.is_symlink()
    killed.line.unlink()  # another process may have got the terminal's number, so the link may work again
    killed.line.symlink_to("/dev/pts/no-terminal")
    with drive("", "modbus-rtu").client() as client:
        wait_for(client, past(0))


def test_serial_line_replaces_a_link_to_its_own_terminal(tmp_path: Path) -> None:
    """The terminal of a killed node may have got the number of the new one."""
    link = tmp_path / "line"
    link.symlink_to(os.devnull)
    _create_link(link, os.devnull)
    assert link.readlink() == Path(os.devnull)
    with pytest.raises(DeviceError, match="exists already"):
        _create_link(link, "/dev/zero")


@pytest.mark.parametrize("transport", ["modbus-tcp", "modbus-rtu"])
def test_modbus_node_leaks_no_thread_or_descriptor(drive: Callable[..., Drive], transport: str) -> None:
    """No thread and no descriptor is left, however often the device was gone."""
    faults = "".join(f'[[faults]]\nkind = "gone"\nstart = "0.{n} s"\nuntil = "0.{n}5 s"\n' for n in range(5))
    node = drive(faults, transport)
    node.end()
    scenario, own = load_scenario(node.scenario), psutil.Process()
    threads, descriptors = list[int](), list[int]()
    for _ in range(3):
        opened = open_node(transport, scenario)
        done = run_nodes({transport: opened}, scenario, None, lambda: False, 0.6)[transport]
        opened.close()
        assert done.ticks == 60
        assert [fault.ticks for fault in done.faults.values()] == [5] * 5
        threads.append(threading.active_count())
        descriptors.append(own.num_fds())
        wait_until(lambda: threading.active_count() <= threads[0] and own.num_fds() <= descriptors[0])


def test_modbus_node_of_the_lift_in_integers(drive: Callable[..., Drive], tmp_path: Path) -> None:
    node = drive()
    node.close()
    text = (EXAMPLES / "scenarios" / "hydraulic-fluid.toml").read_text(encoding="utf-8")
    scale = 'ValveArea = "0.01 mm^2", LoadForce = "1 N", PistonPosition = "0.01 mm", SystemPressure = "1 Pa"'
    modbus = f'[modbus]\nport = {node.port}\ntype = "int32"\nscale = {{ {scale} }}\n\n[[faults]]'
    text = text.replace("../hydraulic-actuator.dbc", str(EXAMPLES / "hydraulic-actuator.dbc"))
    node.scenario.write_text(text.replace("[[faults]]", modbus), encoding="utf-8")
    node.process = subprocess.Popen(node.command, stderr=subprocess.PIPE, text=True)
    with node.client() as client:
        registers = wait_for(client, past(10)).registers
    values = np.array(registers[:COUNTER], ">u2").view(">i4") * [1e-8, 1.0, 1e-5, 1.0]
    wanted = node.ticks(registers[COUNTER] + 1)[-1]
    assert all(math.isclose(one, other, abs_tol=step) for one, other, step in
               zip(values, wanted, (1e-8, 1.0, 1e-5, 1.0), strict=True))  # fmt: skip
