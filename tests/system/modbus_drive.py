"""A DC drive with equations of its own behind a Modbus server of pymodbus: ``python -m tests.system.modbus_drive``.

It runs steadily, or repeats a cycle of voltages, in real time. There is no manual of its registers: 100 has a status
that never changes, 101 the voltage in 0.01 V, 102 the current in mA, 103 the speed in 0.1 rpm, 104 the seconds since
its start. The file of its second argument has ``steady`` or ``cycle``, and a factor on the resistance.
"""

import asyncio
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

R, L, K, J, B, LOAD = 2.5, 0.12, 0.055, 4e-4, 2e-4, 0.02  # ohm, H, V s/rad, kg m^2, N m s/rad, N m
LEVELS, HELD, RAMP = (14.0, 22.0, 11.0, 18.0, 9.0, 20.0), 0.7, 60.0  # V, s, V/s
STEP = 5e-4  # s
FIRST, COUNT = 100, 5
RPM = 30.0 / math.pi  # per rad/s


class Drive:
    """Voltage, current and speed, which follow the clock whenever somebody asks."""

    def __init__(self, order: Path) -> None:
        self._order, self._random = order, np.random.default_rng(7)
        self._begun, self._steps = time.monotonic(), 0
        self.voltage, self.speed = LEVELS[0], (LEVELS[0] - R * LOAD / K) / (R * B / K + K)
        self.current = (B * self.speed + LOAD) / K

    def words(self) -> list[int]:
        """Return what the registers hold now."""
        elapsed = time.monotonic() - self._begun
        manner, factor = self._order.read_text(encoding="ascii").split()
        while self._steps * STEP < elapsed:
            self._advance(R * float(factor), is_steady=manner == "steady")
        measured = (
            567,
            100.0 * (self.voltage + self._random.normal(0.0, 0.005)),
            1000.0 * (self.current + self._random.normal(0.0, 0.004)),
            10.0 * (self.speed * RPM + self._random.normal(0.0, 0.3)),
            elapsed,
        )
        return [round(number) & 0xFFFF for number in measured]

    def _advance(self, resistance: float, *, is_steady: bool) -> None:
        """One step of the midpoint rule."""
        wanted = LEVELS[0 if is_steady else int(self._steps * STEP / HELD) % len(LEVELS)]
        self.voltage += min(max(wanted - self.voltage, -RAMP * STEP), RAMP * STEP)

        def slopes(current: float, speed: float) -> tuple[float, float]:
            return (self.voltage - resistance * current - K * speed) / L, (K * current - B * speed - LOAD) / J

        first = slopes(self.current, self.speed)
        middle = slopes(self.current + 0.5 * STEP * first[0], self.speed + 0.5 * STEP * first[1])
        self.current, self.speed, self._steps = (
            self.current + STEP * middle[0],
            self.speed + STEP * middle[1],
            self._steps + 1,
        )


async def serve(port: int, drive: Drive) -> None:
    """Serve the registers of ``drive`` until the process ends."""

    async def before(_: int, start: int, *others: Any) -> None:
        registers = others[2]  # from ``start`` on; after the address and length of the request
        for at, word in enumerate(drive.words()):
            if 0 <= FIRST + at - start < len(registers):
                registers[FIRST + at - start] = word

    data = [SimData(FIRST, values=[0] * COUNT, datatype=DataType.REGISTERS)]
    await ModbusTcpServer(SimDevice(id=1, simdata=data, action=before), address=("127.0.0.1", port)).serve_forever()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), Drive(Path(sys.argv[2]))))
