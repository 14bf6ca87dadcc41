"""The examples on the page "Signals from a CAN bus" are valid options and sources."""

import re
import tomllib
from pathlib import Path

import pytest

from otolith_drivers.canbus.driver import CanOptions
from otolith_drivers.canbus.options import CanSource

PAGE = (Path(__file__).parents[2] / "docs" / "can.md").read_text(encoding="utf-8")
BLOCKS = [
    "\n".join(line[4:] for line in block.splitlines())
    for block in re.findall(r"(?:^    .*\n|^\n)+", PAGE, re.MULTILINE)
]
SIGNALS = re.findall(r"^    (?!checksum)\w+ = \{ (?:signal|id|node) = .*\}", PAGE, re.MULTILINE)


@pytest.mark.parametrize("line", SIGNALS)
def test_signal_examples_are_valid(line: str) -> None:
    (source,) = tomllib.loads(line.strip()).values()
    CanSource.model_validate(source)


def test_driver_examples_are_valid() -> None:
    shown = 0
    for block in BLOCKS:
        table = tomllib.loads(re.sub(r"^# (?=[a-z_]+ = )", "", block, flags=re.MULTILINE))
        options = table.get("driver", {key: table[key] for key in ("dbc", "eds") if key in table})
        options.pop("type", None)
        CanOptions.model_validate(options)
        shown += bool(options)
    assert shown >= 5
    assert len(SIGNALS) >= 8
