"""``otolith config show`` and ``otolith drivers``: complete, and as right as the files that they come from."""

import json
import re
from pathlib import Path

import pytest

from otolith.machine import LoadedMachine, load_machine
from otolith_drivers import base
from otolith_drivers.errors import ConfigurationError, installation_of
from tests.cli.commands import otolith
from tests.conftest import EXAMPLES

FILES = sorted(EXAMPLES.glob("*.toml"))
DEFAULT = re.compile(r"^# (?=[^\n]+ = )", re.MULTILINE)


def meaning(machine: LoadedMachine) -> tuple[object, ...]:
    """All that the daemon does by a file."""
    file = machine.file
    rest = (file.machine, file.window, file.zenoh, file.recording, file.history, file.evidence, file.swarm)
    return (machine.problem, machine.plan, machine.signal_tables, machine.driver.describe(), *rest)


@pytest.mark.parametrize("example", FILES, ids=lambda path: path.stem)
def test_the_shown_file_means_the_same_with_and_without_its_defaults(example: Path, tmp_path: Path) -> None:
    for path in EXAMPLES.iterdir():
        (tmp_path / path.name).symlink_to(path)
    shown = otolith("config", "show", example).output
    bare, whole = tmp_path / "bare.toml", tmp_path / "whole.toml"
    bare.write_text(shown, encoding="utf-8")
    whole.write_text(DEFAULT.sub("", shown), encoding="utf-8")
    assert len(DEFAULT.findall(shown)) > 50
    expected = meaning(load_machine(tmp_path / example.name))
    assert meaning(load_machine(bare)) == expected
    assert meaning(load_machine(whole)) == expected


def test_values_are_shown_with_their_units() -> None:
    shown = otolith("config", "show", EXAMPLES / "dc-motor.toml").output.splitlines()
    assert '# jitter_limit = "0.005 s"' in shown
    assert 'value = "0.673 H"' in shown
    assert any(line.startswith("##") and "MotorElectrical.ArmatureVoltage" in line for line in shown)


def test_every_driver_is_listed_with_its_keys() -> None:
    document = json.loads(otolith("drivers", "--json").output)
    assert set(document) == set(base.known_drivers())
    for name, row in document.items():
        module = base.find_driver(name)
        assert row["usable"]
        for table, model in (("driver", module.Options), ("signals", module.Source)):
            assert list(row[table]) == [field.alias or key for key, field in model.model_fields.items()]
    assert document["modbus"]["driver"]["timeout"].endswith('s"')


def test_a_driver_without_its_extra_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(base.DRIVERS, "opcua", "otolith_drivers.no_such_library")  # as if asyncua were missing
    row = json.loads(otolith("drivers", "--json").output)["opcua"]
    assert not row["usable"]
    assert installation_of("opcua") in row["reason"]
    with pytest.raises(ConfigurationError, match=re.escape(installation_of("opcua"))):
        otolith("drivers", "opcua")


def test_what_a_machine_file_states_of_its_twin_is_shown_as_written(tmp_path: Path) -> None:
    row = '{ unit = "W", better = "lower", meaning = "heat", expression = "R_a*i^2", at = { i = 1 } }'
    own = f"\n[performance]\nP_i = {row}\n[operation]\nomega = {{ above = 5 }}\n"
    file = tmp_path / "machine.toml"
    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8").replace('dbc = "', f'dbc = "{EXAMPLES}/')
    file.write_text(text + own, encoding="utf-8")
    whole = tmp_path / "whole.toml"
    whole.write_text(otolith("config", "show", file).output, encoding="utf-8")
    twin = load_machine(whole).twin
    assert twin == load_machine(file).twin
    assert "P_i" in [figure.name for figure in twin.performance]
    assert [own.signal for own in twin.operation] == ["omega"]
