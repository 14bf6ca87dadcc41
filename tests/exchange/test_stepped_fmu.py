"""An FMU that only makes steps: one of somebody else, written by hand in C, and our own with its derivatives hidden."""

import re
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from otolith.cli.main import cli
from otolith.estimation.information import QUANTILE
from otolith.exchange.fmu import SAME_FILES, FmuFiles
from otolith.exchange.model_description import Version
from otolith.fmu.instance import FmuInstance
from otolith.machine import LoadedMachine, find_twin, load_machine
from otolith.runtime.fmu_archive import fmu_archive
from otolith.twin.kernel import Excitation, kernel_of
from otolith_drivers.errors import ConfigurationError
from tests.exchange.foreign import machine_text, plain, with_line, without_derivatives
from tests.exchange.foreign import write_machine as write_own
from tests.exchange.test_fmu_estimation import SAME, SLOWER, both, recorded, run
from tests.messages import assert_says, raises_saying
from tests.variants import often

WRITTEN = Path(__file__).parent / "written"
NOMINAL = {row.name: row.nominal for row in find_twin("dc_motor").parameters}
STARTS = {"R_0": "R_a", "L_0": "L_a", "J_0": "J", "K_0": "K_t", "D_0": "D"}

MACHINE = """
[machine]
name = "drive"

[twin]
fmu = "drive.fmu"

[twin.variables]
i = { variable = "winding.i", state = true, start = "winding.i_start", bounds = ["-200 A", "200 A"] }
omega = { variable = "rotor.w", state = true, start = "rotor.w_start", bounds = ["-2000 rad/s", "2000 rad/s"] }
V_a = { variable = "drive.u", unit = "V", bounds = ["-24 V", "24 V"] }
T_load = { variable = "drive.tau", unit = "N*m", bounds = ["-0.2 N*m", "0.2 N*m"] }
R_a = { variable = "winding.R", unit = "ohm" }
D = { variable = "rotor.d", unit = "N*m*s/rad" }

[parameters]
R_a = { low = "3 ohm", high = "12 ohm" }
D = { low = "1e-6 N*m*s/rad", high = "0.01 N*m*s/rad" }

[noise]
i = "5 mA"
omega = "0.02 rad/s"
"""


@cache
def drive(version: Version, changes: tuple[tuple[str, str, str], ...] = ()) -> bytes:
    """Return the archive of the motor of somebody else; ``changes`` are texts of its files, each with another one."""
    texts = {
        "modelDescription.xml": (WRITTEN / f"motor{version}.xml").read_text(encoding="utf-8"),
        f"sources/{version.source}": (WRITTEN / f"motor{version}.c").read_text(encoding="utf-8"),
        "sources/motor.h": (WRITTEN / "motor.h").read_text(encoding="utf-8"),
    }
    for path, old, new in changes:
        assert old in texts[path]
        texts[path] = texts[path].replace(old, new)
    texts[f"sources/{version.source}"] += _left_out(version, texts[f"sources/{version.source}"])
    for name, parameter in STARTS.items():
        texts = {path: text.replace(name, repr(NOMINAL[parameter])) for path, text in texts.items()}
    headers = tuple(name for name in SAME_FILES[version] if name.startswith(f"fmi{version}") and name.endswith(".h"))
    return fmu_archive(FmuFiles(version, "drive", texts, headers))


def _left_out(version: Version, source: str) -> str:
    """Return the functions of the standard that a source lacks, as one that returns an error: importers want all."""
    header = (files("otolith.exchange") / "fmi" / f"fmi{version}Functions.h").read_text(encoding="utf-8")
    names = set(re.findall(rf"\bfmi{version}\w+TYPE\s+(fmi{version}\w+);", header))
    lacking = sorted(name for name in names if f"{name}(" not in source)
    assert lacking
    lines = [f'__asm__(".globl {name}\\n.set {name}, left_out");' for name in lacking]
    return "\n".join(["\n__attribute__((used)) int left_out(void) { return 3; }", *lines, ""])


def written(folder: Path, fmu: bytes, text: str = MACHINE) -> Path:
    """Write an FMU and its machine file; return the path of the file."""
    (folder / "drive.fmu").write_bytes(fmu)
    path = folder / "drive.toml"
    path.write_text(text, encoding="utf-8")
    return path


def loaded(file: Path) -> LoadedMachine:
    return load_machine(file, with_driver=False)


@pytest.mark.parametrize("version", often([Version.TWO], Version))
def test_the_fmu_of_somebody_else_has_the_estimates_of_the_native_twin(version: Version, tmp_path: Path) -> None:
    native = tmp_path / "native.toml"
    native.write_text(machine_text(find_twin("dc_motor"), "", is_native=True), encoding="utf-8")
    own = run(loaded(native), recorded("dc_motor"))
    foreign = run(loaded(written(tmp_path, drive(version))), recorded("dc_motor"))
    for name in ("R_a", "D"):
        row, other = own.last.parameters[name], foreign.last.parameters[name]
        assert None not in {row.value, row.sd, other.value, other.sd}
        assert abs(float(row.value or 0.0) - float(other.value or 0.0)) <= SAME * QUANTILE * float(row.sd or 0.0), name
        assert float(other.sd or 0.0) == pytest.approx(float(row.sd or 0.0), rel=SAME), name
    assert foreign.seconds <= SLOWER * own.seconds


# What is wrong with such an FMU, or with what the machine file says of it: texts of both, and the error.
WRONG: dict[str, tuple[tuple[tuple[str, str, str], ...], tuple[str, str], tuple[str, ...]]] = {
    "a state that is not named": (
        (),
        ('"winding.i", state = true, start = "winding.i_start"', '"winding.i"'),
        ("drive.fmu", "rotor.w", "other states", "state = true"),
    ),
    "a state that nobody sees": (
        (
            (
                "modelDescription.xml",
                'name="winding.i" valueReference="4" causality="output"',
                'name="winding.i" valueReference="4" causality="local"',
            ),
            ("modelDescription.xml", '<Unknown index="5"/>', ""),
        ),
        ('i = { variable = "winding.i", state = true, start = "winding.i_start", bounds = ["-200 A", "200 A"] }', ""),
        ("drive.fmu", "rotor.w", "other states", "state = true"),
    ),
    "no start value": ((), (', start = "rotor.w_start"', ""), ("omega", "'rotor.w'", "start =")),
    "an unknown start value": ((), ('"rotor.w_start"', '"rotor.w_begin"'), ("omega.start", "no such", "rotor.w")),
    "another unit of it": ((), ('"rotor.w_start"', '"winding.L"'), ("omega.start", "'H'", "rad/s")),
    "no states at all": ((), (", state = true", ""), ("twin.fmu", "does not show its states", "state = true")),
    "a derivative": ((), ("state = true", 'state = true, derivative = "omega"'), ("i.derivative", "leave it out")),
    "a start value as a parameter": (
        (),
        ("[parameters]", "[parameters]\nrotor_w_start = { low = 0, high = 1 }"),
        ("rotor_w_start", "start value"),
    ),
    "steps that it does not make": (
        (("modelDescription.xml", '"drive"/>', '"drive" canHandleVariableCommunicationStepSize="true"/>'),),
        ("", ""),
        ("drive.fmu", "0.001 s", "step in [twin]"),
    ),
    "steps in which nothing happens": (
        (),
        ('"drive.fmu"', '"drive.fmu"\nstep = "0.2 ms"'),
        ("drive.fmu", "nothing moves", "0.0002 s", "step"),
    ),
    "a late output": (
        (("sources/motor.h", "m->v[POWER] = m->v[VOLTAGE]", "m->v[POWER] = m->begun * m->v[VOLTAGE]"),),
        ("[parameters]", 'P = "power"\n[parameters]'),
        ("drive.fmu", "power", "late"),
    ),
    "it depends on the time": (
        (("sources/motor.h", "v[VOLTAGE] - v[R]", "v[VOLTAGE] + v[TIME] - v[R]"),),
        ("", ""),
        ("drive.fmu", "depends on the time"),
    ),
}


@pytest.mark.parametrize("case", often(["a state that is not named", "no start value"], WRONG))
def test_what_is_wrong_with_it_is_said_in_one_line(case: str, tmp_path: Path) -> None:
    changes, (old, new), parts = WRONG[case]
    text = MACHINE.replace(old, new)
    assert case.startswith(("steps that", "it depends")) or text != MACHINE
    text += 'P = "1 W"\n' if case == "a late output" else ""
    text = text.replace('i = "5 mA"\n', "") if case == "a state that nobody sees" else text
    with raises_saying(ConfigurationError, *parts):
        loaded(written(tmp_path, drive(Version.TWO, changes), text)).try_fmu()


@pytest.mark.parametrize(("key", "parts"), [
    ('state.i", state = true', ("variables.i", "make steps")),
    ('state.i", start = "R_a"', ("variables.i", "make steps")),
])  # fmt: skip
def test_states_are_not_chosen_where_the_fmu_names_them(key: str, parts: tuple[str, ...], tmp_path: Path) -> None:
    file = with_line(write_own(tmp_path, plain()), 'state.i"', key)
    with raises_saying(ConfigurationError, *parts):
        loaded(file)


@pytest.mark.parametrize("which", ["model exchange", "no FMU"])
def test_a_step_belongs_to_an_fmu_that_makes_steps(which: str, tmp_path: Path) -> None:
    file = write_own(tmp_path, plain())
    if which == "model exchange":
        with_line(file, '"motor.fmu"', '"motor.fmu"\nstep = "1 ms"')
    else:
        file.write_text('[machine]\nname = "m"\n[twin]\nname = "dc_motor"\nstep = "1 ms"\n', encoding="utf-8")
    with raises_saying(ConfigurationError, "twin.step", "leave it out"):
        loaded(file)


def test_check_says_how_it_is_stepped(tmp_path: Path) -> None:
    result = CliRunner().invoke(cli, ["check", "--no-device", str(written(tmp_path, drive(Version.TWO)))])
    assert result.exit_code == 0, result.output
    assert_says(result.output, "whole multiples of 0.001 s", "cannot be restored", "fit of its start values")
    own = write_own(tmp_path, without_derivatives_of(plain(), tmp_path))
    result = CliRunner().invoke(cli, ["check", "--no-device", str(own)])
    assert_says(result.output, "steps of any length", "restored")


def without_derivatives_of(fmu: bytes, folder: Path) -> bytes:
    """Return our own FMU with its derivatives hidden."""
    path = folder / "hidden.fmu"
    path.write_bytes(fmu)
    return without_derivatives(path).read_bytes()


def test_many_particles_go_a_record_on_as_one_does(tmp_path: Path) -> None:
    """The kernel by which a simulation draws."""
    twin = loaded(written(tmp_path, drive(Version.TWO))).twin
    kernel, values = kernel_of(twin), np.array([[6.5, 0.00143], [6.0, 0.002]])
    states, inputs = np.array([[20.0, 0.3], [-5.0, 0.1]]), np.tile([12.0, 0.01], (2, 1))
    _, final = kernel.ensemble(values, states, inputs, inputs, 0.01, 1)
    along = kernel.simulate(values, states, Excitation.uniform(np.tile([12.0, 0.01], (2, 1)), 0.01))
    shown = [[row.name for row in twin.states].index(row.name) for row in twin.outputs]
    assert final[:, shown] == pytest.approx(along[:, 1], rel=1e-9)


def test_a_reset_and_a_restored_state_give_the_same(tmp_path: Path) -> None:
    """At a point that is reached, left and reached again; steps of any length."""
    twin = loaded(write_own(tmp_path, without_derivatives_of(plain(), tmp_path))).twin
    assert twin.fmu is not None
    assert twin.fmu.can_restore
    points = np.array([[0.3, 20.0, 12.0, 0.01], [-0.1, 5.0, -6.0, 0.0], [0.3, 20.0, 12.0, 0.01]])
    points = np.column_stack([points, np.tile([item.start for item in twin.fmu.parameters], (3, 1))])
    restored = FmuInstance(twin.fmu).rows(points, 0.004)
    reset = FmuInstance(replace(twin.fmu, can_restore=False)).rows(points, 0.004)
    assert (restored == reset).all()
    assert (restored[0] == restored[2]).all()


def test_between_its_own_steps_the_states_go_along_a_line(tmp_path: Path) -> None:
    twin = loaded(written(tmp_path, drive(Version.TWO))).twin
    assert twin.fmu is not None
    instance, point = FmuInstance(twin.fmu), np.array([[0.3, 20.0, 12.0, 0.01, 6.5, 0.00143]])
    one, between, two = (length * instance.rows(point, length)[0] for length in (1e-3, 1.4e-3, 2e-3))
    assert between == pytest.approx(one + 0.4 * (two - one), rel=1e-9)


@pytest.mark.full
def test_a_component_is_found_where_it_enters_an_fmu_that_only_makes_steps(tmp_path: Path) -> None:
    hidden = without_derivatives_of(plain(), tmp_path)
    native, imported = both(tmp_path, hidden, "dc_motor", discover=True, torque=0.01)
    (own,), (found,) = native.last.components, imported.last.components
    assert (found.site, found.family, found.input) == ("at_T_load", own.family, own.input)
    for name in ("amplitude", "frequency"):
        row, other = own.values[name], found.values[name]
        assert other.value == pytest.approx(row.value, abs=QUANTILE * float(row.sd or 0.0))
    assert imported.seconds <= SLOWER * native.seconds
