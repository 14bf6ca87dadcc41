"""Machine files: each invalid file of the golden folder gives its error, and valid files load.

A case is a folder with ``machine.toml`` and a list of what its error contains, in which ``{file}`` and ``{folder}``
stand for the paths.
"""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from otolith.cli.commissioning.check import describe
from otolith.health.diagnosis import FindingFeatures, MonitoringPlan, diagnose
from otolith.health.limits import Level
from otolith.health.schema import FindingKind
from otolith.machine import LIBRARY, load_machine, load_rules
from otolith.publishing.zenoh_config import listening
from otolith_drivers.errors import ConfigurationError, OtolithError
from tests.conftest import EXAMPLES, OwnMachine
from tests.messages import assert_says_what_is_listed

GOLDEN = Path(__file__).parents[1] / "golden" / "machine_files"
CASES = sorted(path.parent for path in GOLDEN.glob("*/machine.toml"))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_an_invalid_file_gives_its_error(case: Path) -> None:
    file = case / "machine.toml"
    with pytest.raises(OtolithError) as caught:
        load_machine(file).driver.open(lambda _: None)
    assert caught.value.exit_code == 2
    message = str(caught.value).replace(str(file), "{file}").replace(str(case), "{folder}")
    assert_says_what_is_listed(message, case)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_example_loads(path: Path) -> None:
    machine = load_machine(path)
    lines = describe(machine)
    assert all(any(line.startswith(f"{signal} ") for line in lines) for signal in machine.twin.signals)


def test_all_examples_can_run_on_one_computer() -> None:
    """Each listens on the socket of its own machine."""
    files = [load_machine(path).file for path in sorted(EXAMPLES.glob("*.toml"))]
    endpoints = [
        address
        for file in files
        for address in listening(file.zenoh.listen, f"{file.machine.site}.{file.machine.name}")
    ]
    assert len(set(endpoints)) == len(files)


def test_the_example_gives_its_estimation_problem() -> None:
    machine = load_machine(EXAMPLES / "dc-motor.toml")
    assert [parameter.name for parameter in machine.problem.free] == ["R_a"]
    assert dict(machine.problem.known)["J"] == pytest.approx(0.001171)
    assert machine.problem.noise == (0.005, 0.02)
    assert machine.records == 200
    assert any("MotorMechanical.RotorSpeed" in line for line in describe(machine))
    assert any(line.startswith("first window") and "pso" in line and "1000" in line for line in describe(machine))


def test_the_in_process_example_needs_no_bus() -> None:
    """It has the machine of dc-motor.toml, simulated in the daemon; the twin gives what the shorter file leaves out."""
    simple, whole = load_machine(EXAMPLES / "dc-motor-in-process.toml"), load_machine(EXAMPLES / "dc-motor.toml")
    assert [parameter.name for parameter in simple.problem.free] == ["R_a", "D"]
    assert simple.problem.noise == whole.problem.noise
    assert any("omega from RotorSpeed [rad/s]" in line for line in describe(simple))


def test_every_commented_default_is_the_default(tmp_path: Path) -> None:
    """Removing '# ' from a line of the example changes nothing."""
    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
    plain = load_machine(EXAMPLES / "dc-motor.toml").file
    uncommented = "\n".join(
        line[2:] if line.startswith("# ") and "folder" not in line else line for line in text.splitlines()
    )
    assert uncommented.count("\n[") > text.count("\n[")
    path = tmp_path / "dc-motor.toml"
    path.write_text(uncommented, encoding="utf-8")
    (tmp_path / "dc-motor.dbc").write_bytes((EXAMPLES / "dc-motor.dbc").read_bytes())
    loaded = load_machine(path)
    assert loaded.file.model_copy(update={"driver": plain.driver, "process_noise": {}}) == plain
    assert loaded.problem == load_machine(EXAMPLES / "dc-motor.toml").problem


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("odrive-axis", "F [N] from Axis0_Iq.Iq_Measured * 62.8 [N], frame 0x14"),
        ("canopen-drive", "x [m] from node 5 Position actual value (0x6064:00), TPDO 2 * 1e-06 [m], frame 0x285"),
    ],
)
def test_the_drive_examples_find_their_signals(name: str, line: str) -> None:
    lines = describe(load_machine(EXAMPLES / f"{name}.toml"))
    assert line in lines
    assert not any("warning" in text for text in lines)


def test_any_unit_of_the_dimension_is_accepted(own_machine: OwnMachine) -> None:
    text = own_machine.machine.read_text(encoding="utf-8")
    other = text.replace('"6.5 ohm"', '"6500 mohm"').replace('"0.02 rad/s"', '"0.190985932 rpm"')
    own_machine.machine.write_text(other, encoding="utf-8")
    problem = load_machine(own_machine.machine).problem
    assert problem.free[0].nominal == pytest.approx(6.5)
    assert problem.noise[1] == pytest.approx(0.02)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        load_machine(tmp_path / "none.toml")


def limits_of(own_machine: OwnMachine, row: str, extra: str = "") -> MonitoringPlan:
    text = own_machine.machine.read_text(encoding="utf-8")
    text = re.sub(r"^R_a = .*$", f"R_a = {{ estimate = true, {row} }}", text, flags=re.MULTILINE)
    text = re.sub(r"^\[components\]\n(.+\n)*", "", text, flags=re.MULTILINE)
    own_machine.machine.write_text(text + extra, encoding="utf-8")
    return load_machine(own_machine.machine, with_driver=False).plan


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ('value = "6.5 ohm", watch = "-3 %", act = "-8 %"', [(Level.WATCH, 6.305, True), (Level.ACT, 5.98, True)]),
        ('value = "10 ohm", act = "+10 %"', [(Level.ACT, 11.0, False)]),
        ('watch = ["5.9 ohm", "7000 mohm"]', [(Level.WATCH, 5.9, True), (Level.WATCH, 7.0, False)]),
        ("watch = []", []),
    ],
)
def test_limits_are_relative_or_absolute(
    own_machine: OwnMachine, row: str, expected: list[tuple[Level, float, bool]]
) -> None:
    limits = limits_of(own_machine, row).parameters["R_a"].limits
    assert [(limit.level, limit.is_lower) for limit in limits] == [(level, lower) for level, _, lower in expected]
    assert [limit.value for limit in limits] == pytest.approx([value for _, value, _ in expected])


def test_the_twin_gives_limits_relative_to_the_value_of_the_machine(own_machine: OwnMachine) -> None:
    quantity = limits_of(own_machine, 'value = "10 ohm"').parameters["R_a"]
    assert quantity.part == "winding"
    assert [limit.value for limit in quantity.limits] == pytest.approx([9.5, 14.5, 9.0, 16.5])


def test_a_default_limit_beyond_the_bounds_is_no_error(own_machine: OwnMachine) -> None:
    """The library's lines cannot suit each machine: a limit that no estimate passes does no harm."""
    row = 'value = "6.5 ohm", low = "6.4 ohm", high = "6.6 ohm"'
    assert limits_of(own_machine, row).parameters["R_a"].limits


def test_components_have_limits_by_site(own_machine: OwnMachine) -> None:
    plan = limits_of(own_machine, 'value = "6.5 ohm"', '[components]\nshaft = { watch = "1 mN*m", act = "4 mN*m" }\n')
    assert [limit.value for limit in plan.sites["shaft"].limits] == pytest.approx([0.001, 0.004])
    assert plan.sites["winding"].limits == ()


RULE = """
[[rule]]
id = "aged-cable"
finding = "limit"
subject = ["R_a"]
side = ["above"]
condition = "aged motor cable"
cause = "heat"
advice = "replace the cable"
"""


def test_a_rule_of_the_machine_file_replaces_what_the_packaged_ones_state(own_machine: OwnMachine) -> None:
    rules = limits_of(own_machine, 'value = "6.5 ohm"', RULE).rules
    above = FindingFeatures(FindingKind.LIMIT, "dc_motor", "R_a", "above", "step")
    diagnosis = diagnose(rules, above)
    assert (diagnosis["condition"], diagnosis["advice"]) == ("aged motor cable", "replace the cable")
    assert diagnosis["condition_id"] == "aged-cable"
    below = replace(above, side="below")
    assert diagnose(rules, below) == diagnose(load_rules(), below)


@pytest.mark.parametrize("unit", ["Nm", "mN*m"])
def test_rules_know_the_quantity_of_a_site_however_its_unit_is_written(own_machine: OwnMachine, unit: str) -> None:
    """A user's own twin states its torques in Nm."""
    twin = (LIBRARY / "dc_motor.toml").read_text(encoding="utf-8")
    own = own_machine.machine.with_name("own-twin.toml")
    own.write_text(twin.replace('through = "1/J", unit = "N*m"', f'through = "1/J", unit = "{unit}"'), encoding="utf-8")
    text = own_machine.machine.read_text(encoding="utf-8")
    own_machine.machine.write_text(text.replace('name = "dc_motor"', 'file = "own-twin.toml"'), encoding="utf-8")
    plan = limits_of(own_machine, 'value = "6.5 ohm"')
    features = FindingFeatures(FindingKind.COMPONENT, "dc_motor", "shaft", family="periodic", input="angle", order=1.0)
    features = replace(features, unit=plan.sites["shaft"].unit)
    assert diagnose(plan.rules, features)["condition"] == "unbalanced shaft"


def test_of_the_own_rules_those_with_most_keys_count(own_machine: OwnMachine) -> None:
    stepped = RULE.replace('["above"]', '["above"]\nmanner = ["step"]').replace("aged motor cable", "broken strands")
    rules = limits_of(own_machine, 'value = "6.5 ohm"', RULE + stepped.replace("aged-cable", "broken-cable")).rules
    above = FindingFeatures(FindingKind.LIMIT, "dc_motor", "R_a", "above", "step")
    assert diagnose(rules, above)["condition"] == "broken strands"
    assert diagnose(rules, replace(above, manner="trend"))["condition"] == "aged motor cable"


def test_sources_without_a_delay_are_named(tmp_path: Path) -> None:
    text = (EXAMPLES / "dc-motor-two-buses.toml").read_text(encoding="utf-8")
    text = text.replace('dbc = "dc-motor.dbc"', f'dbc = "{EXAMPLES / "dc-motor.dbc"}"')
    path = tmp_path / "machine.toml"
    path.write_text(text, encoding="utf-8")
    machine = load_machine(path)
    assert "delay of omega: 25 ms" in describe(machine)
    assert {plan.name: plan.source for plan in machine.plans(machine.driver.sampling)}["omega"] == "encoder"
    path.write_text(text.replace(', delay = "25 ms"', ""), encoding="utf-8")
    assert any(line.startswith("no signal has a delay") for line in describe(load_machine(path)))


def test_what_was_learned_belongs_to_the_sources_of_the_signals(tmp_path: Path) -> None:
    """A signal that comes from another source may have other values; the name of a host changes nothing."""
    text = (EXAMPLES / "dc-motor-two-buses.toml").read_text(encoding="utf-8")
    path = tmp_path / "machine.toml"

    def fingerprint(old: str = "", new: str = "") -> str:
        path.write_text(text.replace(old, new), encoding="utf-8")
        return load_machine(path, with_driver=False).signal_fingerprint

    assert fingerprint('host = "127.0.0.1"', 'host = "192.168.0.7"') == fingerprint()
    assert fingerprint('source = "encoder"', 'source = "drive"') != fingerprint()
    assert fingerprint("port = 1502", 'order = "CDAB"') != fingerprint()


def test_one_driver_is_one_source_whether_signals_name_it_or_not(tmp_path: Path) -> None:
    """Signals of different sources have clocks of their own."""
    text = (
        (EXAMPLES / "dc-motor-modbus.toml").read_text(encoding="utf-8").replace("[driver]", '[driver]\nname = "drive"')
    )
    path = tmp_path / "machine.toml"
    path.write_text(text.replace("V_a = { ", 'V_a = { source = "drive", '), encoding="utf-8")
    machine = load_machine(path)
    assert {plan.source for plan in machine.plans(machine.driver.sampling)} == {""}


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ("true", "true is not a limit"),
        ('[true, "-5 %"]', "true is not a limit"),
        ('{ low = "5 ohm" }', "is not a limit"),
        ('"-5"', """'-5' has no unit: write "-5 %" of the nominal value, or "-5 ohm\""""),
        ("4.5", """4.5 has no unit: write "+4.5 %" of the nominal value, or "4.5 ohm\""""),
        ('"5 %"', "has no sign"),
    ],
)
def test_what_is_no_limit_is_refused_with_a_remedy(own_machine: OwnMachine, limit: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(message)) as error:
        limits_of(own_machine, f"watch = {limit}")
    assert "parameters.R_a.watch" in str(error.value)


def test_limits_of_the_twin_that_do_not_fit_are_not_blamed_on_the_machine_file(own_machine: OwnMachine) -> None:
    twin = (LIBRARY / "dc_motor.toml").read_text(encoding="utf-8")
    own = own_machine.machine.with_name("own-twin.toml")
    own.write_text(twin.replace('watch = ["-5 %", "+45 %"]', 'watch = "6.2 ohm"'), encoding="utf-8")
    text = own_machine.machine.read_text(encoding="utf-8")
    own_machine.machine.write_text(text.replace('name = "dc_motor"', 'file = "own-twin.toml"'), encoding="utf-8")
    with pytest.raises(
        ConfigurationError, match=r"limits of the twin do not fit this value: watch: .*write watch and act"
    ):
        limits_of(own_machine, 'value = "6.2 ohm"')


def test_an_unmeasured_input_is_configured_like_any_parameter(tmp_path: Path) -> None:
    """Limits and bounds of [parameters], process noise of a state; a replay needs no driver for it."""
    path = tmp_path / "machine.toml"
    head = '[machine]\nname = "motor"\n[twin]\nname = "dc_motor"\n[signals]\nT_load = { unknown = '
    rows = '[parameters]\nT_load = { value = "20 mN*m", estimate = true, low = "0 N*m", watch = "+50 %" }\n'
    path.write_text(f'{head}"constant" }}\n{rows}', encoding="utf-8")
    machine = load_machine(path, for_replay=True)
    assert machine.twin.signals == ("V_a", "i", "omega")
    (free,) = (row for row in machine.problem.free if row.name == "T_load")
    assert (free.nominal, free.low) == (0.02, 0.0)
    assert machine.plan.parameters["T_load"].limits[0].value == pytest.approx(0.03)
    assert machine.plan.varying == {"T_load"}
    path.write_text(f'{head}"slow" }}\n', encoding="utf-8")
    assert load_machine(path, for_replay=True).problem.process_noise == pytest.approx((0.0, 0.0, 0.004))
    path.write_text(f'{head}"slow" }}\n[process_noise]\nT_load = "1 mN*m/s^0.5"\n', encoding="utf-8")
    machine = load_machine(path, for_replay=True)
    assert machine.problem.process_noise == pytest.approx((0.0, 0.0, 0.001))
    assert "shaft/linear/T_load" in machine.problem.excluded  # what follows the data explains nothing


def test_the_tables_of_a_driver_leave_out_an_unmeasured_input(tmp_path: Path) -> None:
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    text = text.replace("scenarios/", f"{EXAMPLES}/scenarios/").replace('T_load = "0.2 mN*m"', "")
    path = tmp_path / "machine.toml"
    path.write_text(text.replace('{ signal = "LoadTorque" }', '{ unknown = "friction" }'), encoding="utf-8")
    machine = load_machine(path)
    assert set(machine.signal_tables) == set(machine.twin.signals) == {"V_a", "i", "omega"}
    assert "T_load" not in machine.driver.describe()[0]
