"""Polling a Modbus TCP drive: 20 registers at 200 Hz, the driver beside a bare loop over the same library.

The drive is pymodbus's server in a process of its own. Jitter is how far a reading is from the grid of absolute moments
that fits best. ``python -m benchmarks.bench_modbus SECONDS`` (20 each without it).
"""

import asyncio
import socket
import sys
import time
from collections.abc import Sequence
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from otolith.acquisition.ring import Rings
from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.modbus.driver import Options, Source, build

PERIOD = 0.005
NUMBERS = 10  # of two registers
TARGET = 2e-3  # s, of the 99th percentile


def drive(port: int, up: Event) -> None:
    """The server's process."""
    values = [float(index) + 0.1 for index in range(NUMBERS)]
    device = SimDevice(id=1, simdata=[SimData(0, values=values, datatype=DataType.FLOAT32)])

    async def serve() -> None:
        server = ModbusTcpServer(device, address=("127.0.0.1", port))
        await server.serve_forever(background=True)
        up.set()
        await server.serving

    asyncio.run(serve())


def bare(port: int, seconds: float) -> list[float]:
    """Moments of reading by the library alone."""
    client = ModbusTcpClient("127.0.0.1", port=port, timeout=0.5, retries=0)
    client.connect()  # type: ignore[no-untyped-call]  # of a library that is typed but for this
    begun, moments = time.monotonic(), list[float]()
    for index in range(round(seconds / PERIOD)):
        left = begun + index * PERIOD - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        asked = time.monotonic()
        if not client.read_holding_registers(0, count=2 * NUMBERS, device_id=1).isError():
            moments.append(0.5 * (asked + time.monotonic()))
    client.close()  # type: ignore[no-untyped-call]  # as above
    return moments


def ours(port: int, seconds: float) -> tuple[list[float], str]:
    """The same by the driver, into the rings; and what it says of itself."""
    sources = [{"register": 2 * index, "type": "float32", "unit": "V"} for index in range(NUMBERS)]
    signals = tuple(Signal(f"s{at}", "V", Source.model_validate(source)) for at, source in enumerate(sources))
    rings = Rings([signal.name for signal in signals], 4096)
    moments: list[float] = []

    def deliver(samples: Sequence[Sample]) -> None:
        moments.append(samples[0].time)
        rings.deliver(samples)

    driver = build(Options(host="127.0.0.1", port=port), Setup(signals, Path(), PERIOD))
    driver.open(deliver)
    time.sleep(seconds)
    driver.close()
    counters = driver.counters()
    return moments, f"{driver.link().plan}; {counters.received} samples, {counters.lost} lost, {counters.bad} bad"


def jitter(moments: list[float]) -> NDArray[np.float64]:
    """Seconds from the grid, of each reading."""
    times = np.array(moments) - moments[0]
    off = times - np.rint(times / PERIOD) * PERIOD
    found: NDArray[np.float64] = np.abs(off - np.median(off))
    return found


def row(name: str, moments: list[float], seconds: float, cpu: float) -> float:
    off = jitter(moments)
    middle, late = np.quantile(off, (0.5, 0.99))
    rate = (len(moments) - 1) / (moments[-1] - moments[0])
    print(f"  {name:22s} {rate:6.1f} Hz, jitter median {middle * 1e3:5.3f} ms, 99 % {late * 1e3:5.2f} ms, "
          f"longest {off.max() * 1e3:5.2f} ms, {cpu / seconds:5.1%} of a core")  # fmt: skip
    return float(late)


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    context = get_context("spawn")
    up = context.Event()
    process = context.Process(target=drive, args=(port, up), daemon=True)
    process.start()
    if not up.wait(30.0):
        raise RuntimeError("the server did not start")
    print(f"Modbus TCP, {2 * NUMBERS} registers at {1 / PERIOD:.0f} Hz for {seconds:.0f} s, server in another process")
    begun = time.process_time()
    alone = row("bare pymodbus loop", bare(port, seconds), seconds, time.process_time() - begun)
    begun = time.process_time()
    moments, said = ours(port, seconds)
    driven = row("driver into the rings", moments, seconds, time.process_time() - begun)
    print(f"  {said}")
    print(f"  99th percentile {driven / alone:.2f} times that of the bare loop; target {TARGET * 1e3:.0f} ms: "
          f"{'reached' if driven <= TARGET else 'MISSED'}")  # fmt: skip
    process.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main())
