"""The page docs/drive-values.md: each line gives the value that the page states, and each twin exists."""

import re
import tomllib
from pathlib import Path

import pytest

from otolith.machine import find_twin, library_twins
from otolith_drivers.base import Conversion
from otolith_drivers.modbus.driver import Source
from otolith_drivers.units import Quantity

PAGE = (Path(__file__).parents[2] / "docs" / "drive-values.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (.*?) \| `(\w+ = \{.*?\})` \| (\S+) \| (.*?) \|$", PAGE, re.MULTILINE)


def test_every_twin_is_on_the_page() -> None:
    table = PAGE.partition("## How to write it")[0]
    named = {name for name in re.findall(r"`(\w+)`", table) if name in library_twins()}
    assert named | {"hydraulic_actuator"} == set(library_twins())


@pytest.mark.parametrize(("shown", "line", "number", "value"), ROWS, ids=[row[0] for row in ROWS])
def test_a_line_gives_the_stated_value(shown: str, line: str, number: str, value: str) -> None:
    ((signal, keys),) = tomllib.loads(line).items()
    units = {name: twin.unit_of(name) for twin in map(find_twin, library_twins()) for name in twin.signals}
    source = Source.model_validate(keys)
    assert source.unit is not None
    converted = Conversion.of(source, source.unit, units[signal]).value(float(number))
    assert converted == pytest.approx(Quantity(units[signal])(value), rel=1e-4), shown


def test_the_page_has_what_drives_offer() -> None:
    assert len(ROWS) >= 15
