"""Finding signals in a CAN database, and refusing with the name of what is near."""

from pathlib import Path

import pytest

from otolith_drivers.base import Signal
from otolith_drivers.dbc import Source, find_signals, load_dbc
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES

DBC = EXAMPLES / "dc-motor.dbc"


def test_units_are_converted() -> None:
    wanted = find_signals(load_dbc(DBC), [Signal("n", "rpm", Source(signal="RotorSpeed"))], DBC)[0]
    assert wanted.read({"RotorSpeed": 10.471975512}) == pytest.approx(100.0)


def test_a_frame_without_the_signal_gives_no_number() -> None:
    wanted = find_signals(load_dbc(DBC), [Signal("n", "rad/s", Source(signal="RotorSpeed"))], DBC)[0]
    assert wanted.read({}) != wanted.read({})


def test_a_value_out_of_the_databases_range_is_no_reading() -> None:
    wanted = find_signals(load_dbc(DBC), [Signal("i", "A", Source(signal="ArmatureCurrent"))], DBC)[0]
    assert wanted.read({"ArmatureCurrent": 31.9}) == pytest.approx(31.9)
    assert wanted.read({"ArmatureCurrent": 32.767}) != wanted.read({"ArmatureCurrent": 32.767})


@pytest.mark.parametrize(
    ("unit", "source", "sentence"),
    [
        ("rad/s", Source(signal="RotorSped"), "no signal 'RotorSped': did you mean 'RotorSpeed'?"),
        ("rad/s", Source(signal="RotorSpeed", message="Motor"), "no message 'Motor'"),
        ("A", Source(signal="RotorSpeed"), "unit 'rad/s' does not measure what 'A' does"),
        ("1", Source(signal="ElectricalAliveCounter"), "has no unit: set 'unit' beside it"),
    ],
)
def test_refusals(unit: str, source: Source, sentence: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        find_signals(load_dbc(DBC), [Signal("n", unit, source)], DBC)
    assert sentence in str(caught.value)
    assert caught.value.key == ("signals", "n")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content", ["", "BO_ what", "\x00\x01", 'VERSION 1\nBO_ 1 A: 8 X\n SG_ S : 99|64@1+ (1,0) [0|0] "" X\n']
)
def test_a_broken_database_is_refused_in_one_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "broken.dbc"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        find_signals(load_dbc(path), [Signal("n", "V", Source(signal="S"))], path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
