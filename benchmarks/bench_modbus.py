"""Polling a Modbus TCP drive: 20 registers at 200 Hz, the driver compared with a bare loop over the same library.

The drive is pymodbus's server in its own process. Jitter is the distance of a reading from the best-fitting grid of
absolute times. ``python -m benchmarks.bench_modbus SECONDS`` (20 each without it).
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
VALUES = 10  # of two registers each
TARGET = 2e-3  # s, of the 99th percentile


def run_server(port: int, ready: Event) -> None:
    """Entry point of the server's process."""
    values = [float(index) + 0.1 for index in range(VALUES)]
    device = SimDevice(id=1, simdata=[SimData(0, values=values, datatype=DataType.FLOAT32)])

    async def serve() -> None:
        server = ModbusTcpServer(device, address=("127.0.0.1", port))
        await server.serve_forever(background=True)
        ready.set()
        await server.serving

    asyncio.run(serve())


def poll_bare(port: int, seconds: float) -> list[float]:
    """Times of the readings by the library alone."""
    client = ModbusTcpClient("127.0.0.1", port=port, timeout=0.5, retries=0)
    client.connect()  # type: ignore[no-untyped-call]  # pymodbus leaves connect and close untyped
    start, moments = time.monotonic(), list[float]()
    for index in range(round(seconds / PERIOD)):
        left = start + index * PERIOD - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        sent = time.monotonic()
        if not client.read_holding_registers(0, count=2 * VALUES, device_id=1).isError():
            moments.append(0.5 * (sent + time.monotonic()))
    client.close()  # type: ignore[no-untyped-call]  # pymodbus leaves connect and close untyped
    return moments


def poll_with_driver(port: int, seconds: float) -> tuple[list[float], str]:
    """Times of the readings by the driver into the rings, and its plan and counters."""
    sources = [{"register": 2 * index, "type": "float32", "unit": "V"} for index in range(VALUES)]
    signals = tuple(Signal(f"s{at}", "V", Source.model_validate(source)) for at, source in enumerate(sources))
    rings = Rings([signal.name for signal in signals], 4096)
    moments: list[float] = []

    def deliver(samples: Sequence[Sample]) -> None:
        moments.extend(sample.time for sample in samples if sample.signal == signals[0].name)
        rings.deliver(samples)

    driver = build(Options(host="127.0.0.1", port=port), Setup(signals, Path(), PERIOD))
    driver.open(deliver)
    time.sleep(seconds)
    driver.close()
    counters = driver.counters()
    return moments, f"{driver.link().plan}; {counters.received} samples, {counters.lost} lost, {counters.bad} bad"


def jitter(moments: list[float]) -> NDArray[np.float64]:
    """Distance of each reading from the grid, in seconds."""
    times = np.array(moments) - moments[0]
    offset = times - np.rint(times / PERIOD) * PERIOD
    deviation: NDArray[np.float64] = np.abs(offset - np.median(offset))
    return deviation


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
    ready = context.Event()
    process = context.Process(target=run_server, args=(port, ready), daemon=True)
    process.start()
    if not ready.wait(30.0):
        raise RuntimeError("the server did not start")
    print(f"Modbus TCP, {2 * VALUES} registers at {1 / PERIOD:.0f} Hz for {seconds:.0f} s, server in another process")
    start = time.process_time()
    bare_late = row("bare pymodbus loop", poll_bare(port, seconds), seconds, time.process_time() - start)
    start = time.process_time()
    moments, summary = poll_with_driver(port, seconds)
    driver_late = row("driver into the rings", moments, seconds, time.process_time() - start)
    print(f"  {summary}")
    print(f"  99th percentile {driver_late / bare_late:.2f} times that of the bare loop; target {TARGET * 1e3:.0f} ms: "
          f"{'reached' if driver_late <= TARGET else 'MISSED'}")  # fmt: skip
    process.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main())
