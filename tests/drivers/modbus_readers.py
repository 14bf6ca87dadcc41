"""Modbus drivers for tests, and a context manager that keeps what they deliver."""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from otolith_drivers.base import Link, Sample, Setup, Signal
from otolith_drivers.modbus.driver import ModbusPoller, Options, Source, build
from tests.waiting import wait_for

PERIOD = 0.01
TIMEOUT = 0.2  # s; on a busy computer as well, a server that answers at all does so within this


def floats(*values: float) -> dict[int, int]:
    """The registers of numbers of 32 bits, from address 0 on."""
    return dict(enumerate(struct.unpack(f">{2 * len(values)}H", struct.pack(f">{len(values)}f", *values))))


def source(**keys: object) -> Source:
    return Source.model_validate({"type": "float32", "unit": "V", **keys})


def poller(port: int, sources: Sequence[Source], period: float = PERIOD, **options: object) -> ModbusPoller:
    signals = tuple(Signal(f"s{index}", "V", source) for index, source in enumerate(sources))
    parsed = Options.model_validate({"host": "127.0.0.1", "port": port, "timeout": f"{TIMEOUT} s", **options})
    return build(parsed, Setup(signals, Path(), period))


class Listener:
    """Opens a driver, keeps what it delivers, closes it."""

    def __init__(self, driver: ModbusPoller) -> None:
        self.driver = driver
        self.samples: list[Sample] = []

    def __enter__(self) -> Self:
        self.driver.open(self.samples.extend)
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.close()

    def of(self, name: str) -> list[Sample]:
        return [sample for sample in self.samples if sample.signal == name]

    def wait(self, condition: Callable[[Link], bool]) -> None:
        wait_for(lambda: condition(self.driver.link()))


TWO = [source(register=0), source(register=2)]
