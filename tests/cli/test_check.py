"""What ``otolith check`` says of signals that come, and of those that do not."""

from pathlib import Path

from otolith.cli.check import check_machine
from tests.conftest import OwnMachine


def heard(machine: Path, *, all_of_it: bool = True) -> dict[str, str]:
    """Of each signal what was heard, and everything under "all"."""
    lines: list[str] = []
    assert check_machine(machine, lines.append, with_device=True) == all_of_it
    return {line.split()[1].rstrip(":"): line for line in lines if line.startswith("heard ")} | {
        "all": "\n".join(lines)
    }


def test_a_signal_is_shown_with_its_value_so_that_a_wrong_register_or_bit_is_seen(tmp_path: Path) -> None:
    found = heard(OwnMachine(tmp_path, "in-process").machine)
    assert found["omega"].endswith(" rad/s")
    assert ", now " in found["i"]
    assert "otolith probe" not in found["all"]


def test_a_machine_that_is_silent_is_told_from_a_signal_that_is_looked_for_in_the_wrong_place(tmp_path: Path) -> None:
    silent = heard(OwnMachine(tmp_path / "tcp", "modbus-tcp").machine, all_of_it=False)
    assert silent["V_a"].endswith(": is the machine on?")
    assert "no connection: Connection refused" in silent["all"]
    assert silent["all"].endswith("what is there is shown by 'otolith probe modbus'")

    machine = OwnMachine(tmp_path / "bits")
    text = machine.machine.read_text(encoding="utf-8")
    log = tmp_path / "data.log"
    frames = [f"({100 + 0.01 * k:.6f}) can0 281#0100020003000400" for k in range(1000)]
    log.write_text("\n".join([*frames, ""]), encoding="utf-8")
    before, _, after = text.partition("[driver]")
    rest = after[after.index("[signals]") :]
    driver = f'[driver]\ntype = "replay"\nfile = "{log}"\ncan = {{ dbc = "{machine.dbc}" }}\n'
    machine.machine.write_text(before + driver + rest, encoding="utf-8")
    half = heard(machine.machine, all_of_it=False)
    assert half["omega"].endswith(", now 0.01 rad/s")
    assert half["i"].endswith(": others come, so is its place in [signals] right?")
