"""Simulated Modbus drives that end with their test."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.drivers.drives import Drive


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[Callable[..., Drive]]:
    started: list[Drive] = []

    def start(*arguments: str) -> Drive:
        started.append(Drive(tmp_path, *arguments))
        return started[-1]

    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    yield start
    for each in started:
        each.close()
