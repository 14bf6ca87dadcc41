"""A simulated machine as a Modbus drive in a process of its own, and a client's view of it."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from pymodbus import FramerType, ModbusException
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.pdu import ModbusPDU

from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.conftest import EXAMPLES, free_port
from tests.waiting import PATIENCE

PLANT = [sys.executable, "-m", "otolith", "plant"]
REGISTERS, COUNTER = 9, 8
TIMEOUT = 1.0  # s; an answer arrives within this time even on a busy computer
Client = ModbusTcpClient | ModbusSerialClient
ORDERS = {"ABCD": [0, 1, 2, 3], "DCBA": [3, 2, 1, 0], "BADC": [1, 0, 3, 2], "CDAB": [2, 3, 0, 1]}


class Drive:
    """A simulated machine as a Modbus drive, with its summary at the end."""

    def __init__(self, folder: Path, more: str = "", transport: str = "modbus-tcp", modbus: str = "") -> None:
        self.port, self.line = free_port(socket.SOCK_STREAM), folder / "ttyDrive"
        self.transport, self.scenario, self.summary = transport, folder / "scenario.toml", folder / "summary.json"
        self.scenario.write_text(
            f'plant = "dc_motor"\ndbc = "{EXAMPLES / "dc-motor.dbc"}"\nseed = 5\n'
            'set_points = [{ at = "0 s", speed = "10 rad/s" }]\n'
            '[noise]\ncurrent = "5 mA"\nspeed = "0.02 rad/s"\n'
            f'[modbus]\nport = {self.port}\nline = "{self.line}"\n{modbus}\n{more}',
            encoding="utf-8",
        )
        self.command = [*PLANT, str(self.scenario), "--as", transport, "--summary", str(self.summary)]
        self.process = subprocess.Popen(self.command, stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        self.title = self.process.stderr.readline()
        if "Ctrl-C ends it" not in self.title:
            _, rest = self.process.communicate(timeout=PATIENCE)
            raise AssertionError(self.title + rest)

    def client(self, timeout: float = TIMEOUT) -> Client:
        if self.transport == "modbus-tcp":
            return ModbusTcpClient("127.0.0.1", port=self.port, timeout=timeout, retries=0)
        return ModbusSerialClient(str(self.line), framer=FramerType.RTU, baudrate=115200, timeout=timeout, retries=0)

    def ticks(self, count: int) -> list[list[float]]:
        return [list(tick.measured.values()) for tick in islice(simulate(load_scenario(self.scenario)), count)]

    def end(self, number: signal.Signals = signal.SIGTERM) -> tuple[int, dict[str, Any]]:
        """Exit code and summary."""
        self.process.send_signal(number)
        _, self.stderr = self.process.communicate(timeout=PATIENCE)
        assert "Traceback" not in self.stderr
        return self.process.returncode, json.loads(self.summary.read_text(encoding="utf-8"))

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate(timeout=PATIENCE)


def floats(registers: Sequence[int], order: str = "ABCD") -> list[float]:
    """The four signals, decoded independently of the drive's code."""
    data = np.array(registers[:COUNTER], ">u2").view("u1").reshape(4, 4)[:, np.argsort(ORDERS[order])]
    return list(np.ascontiguousarray(data).view(">f4").ravel().astype(float))


def wait_for(client: Client, condition: Callable[[ModbusPDU], bool]) -> ModbusPDU:
    """The first answer that meets ``condition``; the client reconnects if it must."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            answer = client.read_holding_registers(0, count=REGISTERS)
            if condition(answer):
                return answer
        except ModbusException:
            pass
        time.sleep(0.01)
    raise AssertionError(f"no such answer within {PATIENCE:g} s")


def past(index: int) -> Callable[[ModbusPDU], bool]:
    return lambda answer: not answer.isError() and answer.registers[COUNTER] >= index


def line_says(line: int, enough: int) -> bytes:
    """At least ``enough`` bytes from a line."""
    data = b""
    while len(data) < enough:
        assert select.select([line], [], [], PATIENCE)[0], data.hex()
        data += os.read(line, 1000)
    return data
