"""Faults of the simulated Modbus drive: what a client misses is what the drive counts as withheld."""

import os
import socket
import time
from collections.abc import Callable

import numpy as np
import pytest
from pymodbus import ModbusException

from tests.drivers.drives import COUNTER, REGISTERS, Drive, floats, line_says, past, wait_for
from tests.waiting import PATIENCE


def test_dropouts_are_all_counted(drive: Callable[..., Drive]) -> None:
    node = drive('[[faults]]\nkind = "dropouts"\nshare = 0.1\nstart = "0.2 s"\n')
    answered = silent = 0
    with node.client() as client:
        while answered + silent < 150:
            try:
                assert not client.read_holding_registers(0, count=REGISTERS).isError()
                answered += 1
            except ModbusException:
                silent += 1
            time.sleep(0.01)  # the drive draws again in each tick
    _, done = node.end()
    assert silent > 0
    assert (done["answers"], done["faults"][0]["withheld"]) == (answered, silent)
    assert done["functions"] == {"3": answered + silent}


def test_gone_tcp_drive_closes_its_port_and_returns(drive: Callable[..., Drive]) -> None:
    node = drive('[[faults]]\nkind = "gone"\nstart = "3 s"\nuntil = "4 s"\n')
    with node.client() as client:
        wait_for(client, past(0))
        with socket.create_connection(("127.0.0.1", node.port)) as idle:
            idle.settimeout(PATIENCE)
            assert idle.recv(1) == b""  # the drive itself closes what is open
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", node.port))
        back = wait_for(client, past(0)).registers
    assert back[COUNTER] >= 400
    assert np.array_equal(floats(back), np.array(node.ticks(back[COUNTER] + 1)[-1], np.float32))
    assert node.end()[1]["faults"][0]["ticks"] == 100


def test_gone_serial_drive_is_silent_and_returns(drive: Callable[..., Drive]) -> None:
    node, silent = drive('[[faults]]\nkind = "gone"\nstart = "1 s"\nuntil = "2 s"\n', "modbus-rtu"), 0
    latest = 0
    with node.client() as client:
        while latest < 200:
            try:
                latest = client.read_holding_registers(0, count=REGISTERS).registers[COUNTER]
                assert not 100 <= latest < 200
            except ModbusException:
                silent += 1
            time.sleep(0.01)
    _, done = node.end()
    assert silent > 0
    assert done["faults"] == [{"number": 0, "kind": "gone", "ticks": 100, "withheld": silent, "refused": 0}]


def test_word_order_changes_at_the_scenarios_time(drive: Callable[..., Drive]) -> None:
    node = drive('[[faults]]\nkind = "word_order"\norder = "CDAB"\nstart = "1 s"\n', "modbus-tcp", 'order = "BADC"')
    with node.client() as client:
        seen = [wait_for(client, past(index)).registers for index in (0, 100)]
    ticks = node.ticks(seen[-1][COUNTER] + 1)
    for registers in seen:
        order = "BADC" if registers[COUNTER] < 100 else "CDAB"
        assert np.array_equal(floats(registers, order), np.array(ticks[registers[COUNTER]], np.float32))


def test_exception_for_some_registers(drive: Callable[..., Drive]) -> None:
    node = drive('[[faults]]\nkind = "exception"\ncode = 6\nfirst = 4\nlast = 5\nstart = "0 s"\n')
    with node.client() as client:
        asked = {(address, count): client.read_holding_registers(address, count=count)
                 for address, count in ((0, 4), (0, 5), (4, 2), (5, 1), (6, 3))}  # fmt: skip
    assert {where: answer.exception_code for where, answer in asked.items() if answer.isError()} == {
        (0, 5): 6, (4, 2): 6, (5, 1): 6
    }  # fmt: skip
    assert node.end()[1]["faults"][0]["refused"] == 3


@pytest.mark.parametrize("transport", ["modbus-tcp", "modbus-rtu"])
def test_garbage_is_sent_on_the_line(drive: Callable[..., Drive], transport: str) -> None:
    node = drive('[[faults]]\nkind = "garbage"\nshare = 1.0\nstart = "0.5 s"\nuntil = "3 s"\n', transport)
    if transport == "modbus-tcp":
        with socket.create_connection(("127.0.0.1", node.port)) as connection:
            line_says(connection.fileno(), 100)
    else:
        line = os.open(node.line, os.O_RDWR | os.O_NOCTTY)
        line_says(line, 100)
        os.close(line)
    with node.client() as client:
        wait_for(client, past(300))
    assert node.end()[1]["faults"][0]["ticks"] == 250
