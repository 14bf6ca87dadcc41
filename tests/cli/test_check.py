"""``otolith check``: the lines about signals that come, and about those that do not."""

from pathlib import Path

import pytest

from otolith.cli.commissioning.check import check_machine, describe, without_sensors
from otolith.machine import load_machine
from otolith_drivers.errors import ConfigurationError
from tests.conftest import OwnMachine
from tests.messages import assert_says


def checked(machine: Path, *, complete: bool = True) -> dict[str, str]:
    """The line of each signal, and all lines under "all"."""
    lines: list[str] = []
    assert check_machine(machine, lines.append, with_device=True) == complete
    return {line.split()[1].rstrip(":"): line for line in lines if line.startswith("received ")} | {
        "all": "\n".join(lines)
    }


def test_every_signal_is_shown_with_its_latest_value(tmp_path: Path) -> None:
    lines = checked(OwnMachine(tmp_path, "in-process").machine)
    assert lines["omega"].endswith(" rad/s")
    assert ", now " in lines["i"]
    assert "otolith probe" not in lines["all"]


def test_a_parameter_without_limits_is_named(tmp_path: Path) -> None:
    machine = OwnMachine(tmp_path, "in-process")
    text = machine.machine.read_text(encoding="utf-8")
    row = 'D = { value = "0.00143 N*m*s/rad", estimate = true, watch = [] }'
    machine.machine.write_text(text.replace('D = "0.00143 N*m*s/rad"', row), encoding="utf-8")
    lines = describe(load_machine(machine.machine))
    (without,) = (line for line in lines if "no change of it is an event" in line)
    assert without.startswith("limits of D: none")
    assert any(line.startswith("limits of R_a: ") for line in lines)


def test_the_limits_that_are_proposed_are_accepted(tmp_path: Path) -> None:
    """Also for a parameter whose nominal value is zero, of which there are no percentages."""
    path = tmp_path / "machine.toml"
    text = '[machine]\nname = "motor"\n[twin]\nname = "dc_motor"\n[signals]\nT_load = { unknown = "constant" }\n'
    path.write_text(text, encoding="utf-8")
    (line,) = (line for line in describe(load_machine(path, for_replay=True)) if line.startswith("limits of T_load"))
    proposed = line.partition("write ")[2].removesuffix(" under [parameters]")
    path.write_text(f"{text}[parameters]\n{proposed}\n", encoding="utf-8")
    assert len(load_machine(path, for_replay=True).plan.parameters["T_load"].limits) == 2


def test_silent_machine_and_missing_signal_get_their_own_remark(tmp_path: Path) -> None:
    silent = checked(OwnMachine(tmp_path / "tcp", "modbus-tcp").machine, complete=False)
    assert silent["V_a"].endswith(": is the machine on?")
    assert "no connection: Connection refused" in silent["all"]
    assert silent["all"].endswith("'otolith probe modbus' shows what is on the bus")

    machine = OwnMachine(tmp_path / "bits")
    text = machine.machine.read_text(encoding="utf-8")
    log = tmp_path / "data.log"
    frames = [f"({100 + 0.01 * k:.6f}) can0 281#0100020003000400" for k in range(1000)]
    log.write_text("\n".join([*frames, ""]), encoding="utf-8")
    before, _, after = text.partition("[driver]")
    rest = after[after.index("[signals]") :]
    driver = f'[driver]\ntype = "replay"\nfile = "{log}"\ncan = {{ dbc = "{machine.dbc}" }}\n'
    machine.machine.write_text(before + driver + rest, encoding="utf-8")
    half = checked(machine.machine, complete=False)
    assert half["omega"].endswith(", now 0.01 rad/s")
    assert half["i"].endswith(": other signals come, so check its entry in [signals]")


@pytest.mark.full
def test_what_is_lost_without_two_sensors(tmp_path: Path) -> None:
    """A resistance and an opening that only act together, and torques that have one scale."""
    path = tmp_path / "machine.toml"
    text = '[machine]\nname = "p"\n[twin]\nname = "pump"\n[signals]\nT_m = { unknown = "constant" }\n'
    path.write_text(f'{text}u = {{ unknown = "constant" }}\n[parameters]\nT_c = "0.3 N*m"\n', encoding="utf-8")
    lines = without_sensors(load_machine(path, for_replay=True))
    impossible = {line.split()[1]: line for line in lines if line.startswith("! ")}
    assert set(impossible) == {"k_v", "u"}
    assert "only together with u" in impossible["k_v"]
    (scale,) = (line for line in lines if "only their ratios" in line)
    assert scale.startswith("T_m: as right as the given t_1, ")


OUTLETS = '[outlets.prometheus]\n[outlets.webhook]\nurl = "https://tickets.example/hook"\nsecret_file = "secret"\n'


def test_outlets_are_named_with_where_they_pass_on_to(tmp_path: Path) -> None:
    own = OwnMachine(tmp_path, "in-process").machine
    own.write_text(f"{own.read_text(encoding='utf-8')}\n{OUTLETS}", encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        checked(own)
    assert_says(str(caught.value), "machine.toml", "outlets.webhook.secret_file", str(tmp_path / "secret"))
    (tmp_path / "secret").write_text("a", encoding="utf-8")
    (tmp_path / "secret").chmod(0o600)
    lines = checked(own)["all"]
    assert_says(lines, "outlet prometheus", "http://127.0.0.1:8421/metrics", "outlet webhook", "tickets.example")


@pytest.mark.parametrize(
    ("table", "needles"),
    [
        ('[outlets.prometheus]\nlisten = "0.0.0.0:8421"\n', ("outlets.prometheus", "0.0.0.0:8421", "hosts")),
        ("[outlets.prometheus]\nport = 1\n", ("outlets.prometheus.port", "listen")),
        ('[outlets.mail]\nhost = "a"\nsender = "a@b"\nto = []\n', ("outlets.mail.to", "at least 1")),
        ('[outlets.mqtt]\nhost = "a"\nport = 70000\n', ("outlets.mqtt.port", "70000", "65535")),
        ('[outlets.email]\nhost = "a"\n', ("outlets.email", "mail")),
    ],
)
def test_a_mistake_in_an_outlet_is_named_with_its_key(tmp_path: Path, table: str, needles: tuple[str, ...]) -> None:
    own = OwnMachine(tmp_path, "in-process").machine
    own.write_text(f"{own.read_text(encoding='utf-8')}\n{table}", encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load_machine(own)
    assert_says(str(caught.value), "machine.toml", *needles)
