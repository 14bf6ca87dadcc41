"""A twin whose equations are in an FMU is estimated as the same twin in the language of twins."""

import re
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.information import QUANTILE
from otolith.estimation.posterior import Posterior
from otolith.exchange.exported import exported_twin
from otolith.exchange.model_description import Version
from otolith.health.schema import ReportDocument
from otolith.machine import LIBRARY, LoadedMachine, find_twin, load_machine
from otolith.twin.definition import Definition
from otolith.twin.kernel import Excitation, kernel_of
from otolith.twin.language import read_twin
from otolith_drivers.config_files import SourceFile
from otolith_drivers.errors import ConfigurationError
from tests.exchange.foreign import exported, machine_text, only_co_simulation, plain, without_derivatives, write_machine
from tests.messages import raises_saying
from tests.simulation.motors import PERIOD
from tests.variants import often, often_rows

SAME = 0.02  # of half a 95 % interval: how far values may differ, and of the interval itself
SLOWER = 30.0  # times, at most
RECORDS, HELD, WINDOWS, SUBSTEPS = 200, 10, 5, 8
CHANGED = 0.93  # of the nominal value: what the first estimated parameter is in the plant


class Run(NamedTuple):
    """A twin that has learned from some windows."""

    last: ReportDocument
    seconds: float  # Median of a window


def steps(twin: Definition, records: int) -> Array:
    """Inputs (records, inputs) that change after each ten records within their ranges."""
    random = np.random.default_rng(1)
    ends = ((row.low, row.high) for row in twin.inputs)
    return np.column_stack([random.uniform(low, high, records // HELD).repeat(HELD) for low, high in ends])


@cache
def recorded(name: str, torque: float = 0.0) -> Array:
    """Inputs and outputs (records, signals) of a machine with one changed parameter; ``torque`` is on its shaft."""
    twin = find_twin(name)
    records = RECORDS * WINDOWS
    driving = steps(twin, records)
    acting = driving.copy()
    acting[:, -1] += torque * np.sin(20.0 * PERIOD * np.arange(records))
    values = np.array([row.nominal for row in twin.parameters])
    values[[row.role == "estimated" for row in twin.parameters].index(True)] *= CHANGED
    initial = np.array([[row.initial for row in twin.states]])
    excitation = Excitation.uniform(acting, PERIOD, SUBSTEPS)
    shown = kernel_of(twin).simulate(values[None], initial, excitation)[0]
    noise = np.random.default_rng(2).standard_normal(shown.shape) * [row.noise for row in twin.outputs]
    return np.column_stack([driving, shown + noise])


def run(machine: LoadedMachine, values: Array, *, discover: bool = False) -> Run:
    """Adapt the twin of a machine file to windows of recorded values."""
    problem = replace(machine.problem, discover=discover)
    state, seconds = initial_state("imported", "site", problem, machine.plan), []
    for index in range(WINDOWS):
        part = values[index * RECORDS : (index + 1) * RECORDS]
        window = Window.whole(index, index * RECORDS * PERIOD, PERIOD, machine.twin.signals, part)
        begun = time.perf_counter()
        state, report = adapt(state, window)
        seconds.append(time.perf_counter() - begun)
    return Run(report.document, float(np.median(seconds)))


def both(folder: Path, fmu: bytes, name: str, *, discover: bool = False, torque: float = 0.0) -> tuple[Run, Run]:
    """Learn from the same records with the twin of the library, and with an FMU of it."""
    path = write_machine(folder, fmu, name)
    native = folder / "native.toml"
    native.write_text(machine_text(find_twin(name), "", is_native=True), encoding="utf-8")
    machines = (load_machine(file, with_driver=False) for file in (native, path))
    first, second = (run(machine, recorded(name, torque), discover=discover) for machine in machines)
    return first, second


def assert_same(native: Run, imported: Run) -> None:
    """Assert that the values and the intervals of all parameters are the same to 2 % of an interval."""
    for name, row in native.last.parameters.items():
        other = imported.last.parameters[name]
        assert (row.status, row.unit) == (other.status, other.unit), name
        assert None not in {row.value, row.sd, other.value, other.sd}, name
        assert abs(float(row.value or 0.0) - float(other.value or 0.0)) <= SAME * QUANTILE * float(row.sd or 0.0), name
        assert float(other.sd or 0.0) == pytest.approx(float(row.sd or 0.0), rel=SAME), name
    assert imported.seconds <= SLOWER * native.seconds


ALL = [(name, version) for name in ("dc_motor", "dc_motor_coulomb", "pump") for version in Version]


@pytest.mark.parametrize(("name", "version"), often_rows([("dc_motor", Version.TWO)], ALL))
def test_it_has_the_values_and_intervals_of_the_same_twin(name: str, version: Version, tmp_path: Path) -> None:
    assert_same(*both(tmp_path, plain(name, version), name))


@pytest.mark.parametrize("version", often([Version.THREE], Version))
def test_co_simulation_that_shows_its_derivatives_is_the_same(version: Version, tmp_path: Path) -> None:
    path = tmp_path / "shown.fmu"
    path.write_bytes(plain(version=version))
    assert_same(*both(tmp_path, only_co_simulation(path).read_bytes(), "dc_motor"))


@pytest.mark.parametrize("version", often([Version.TWO], Version))
def test_co_simulation_that_only_makes_steps_is_the_same(version: Version, tmp_path: Path) -> None:
    path = tmp_path / "steps.fmu"
    path.write_bytes(plain(version=version))
    assert_same(*both(tmp_path, without_derivatives(path).read_bytes(), "dc_motor"))


DERIVATIVES = """
    Instance *instance = component;
    for (size_t row = 0; row < unknown_count; row++) {
        sensitivity[row] = 0.0;
    }
    for (size_t at = 0; at < known_count; at++) {
        const double value = instance->memory.variables[knowns[at]], step = 1e-6 * (fabs(value) + 1.0);
        for (int sign = -1; sign <= 1; sign += 2) {
            set(&instance->memory, knowns[at], value + sign * step);
            for (size_t row = 0; row < unknown_count; row++) {
                sensitivity[row] += FACTOR * seed[at] * sign * current(&instance->memory)[unknowns[row]] / (2.0 * step);
            }
        }
        set(&instance->memory, knowns[at], value);
    }
    return fmi2OK;
"""


def with_derivatives(factor: str) -> bytes:
    """Return a motor that offers directional derivatives, which are ``factor`` times the right ones."""
    body = DERIVATIVES.replace("FACTOR", factor)
    refusal = '    return fail(component, "this FMU has no directional derivatives");\n'
    return exported(
        "dc_motor",
        changes={
            "sources/fmi2.c": lambda text: text.replace(refusal, body),
            "modelDescription.xml": lambda text: text.replace(
                "<ModelExchange ", '<ModelExchange providesDirectionalDerivative="true" '
            ),
        },
    )


def test_with_directional_derivatives_it_is_the_same(tmp_path: Path) -> None:
    assert_same(*both(tmp_path, with_derivatives("1.0"), "dc_motor"))


def test_wrong_directional_derivatives_are_refused(tmp_path: Path) -> None:
    machine = load_machine(write_machine(tmp_path, with_derivatives("2.0")), with_driver=False)
    with raises_saying(ConfigurationError, "motor.fmu", "directional derivative", "state.i"):
        machine.try_fmu()


@pytest.mark.full
def test_a_component_is_found_at_the_input_where_it_enters(tmp_path: Path) -> None:
    native, imported = both(tmp_path, plain(), "dc_motor", discover=True, torque=0.01)
    (own,), (found,) = native.last.components, imported.last.components
    assert (found.site, found.family, found.input) == ("at_T_load", own.family, own.input)
    for name in ("amplitude", "frequency"):
        row, other = own.values[name], found.values[name]
        assert other.value == pytest.approx(row.value, abs=QUANTILE * float(row.sd or 0.0))
    assert imported.seconds <= SLOWER * native.seconds


@pytest.mark.full
def test_a_load_without_a_sensor_is_taken_as_constant(tmp_path: Path) -> None:
    path = write_machine(tmp_path, plain(), more='[signals]\nT_load = { unknown = "constant" }')
    values = recorded("dc_motor")
    machine = load_machine(path, with_driver=False)
    twin, held = find_twin("dc_motor"), 0.04
    driving = np.column_stack([values[:, 0], np.full(len(values), held)])
    initial = np.array([[row.initial for row in twin.states]])
    nominal = np.array([[row.nominal for row in twin.parameters]])
    shown = kernel_of(twin).simulate(nominal, initial, Excitation.uniform(driving, PERIOD, SUBSTEPS))[0]
    shown += np.random.default_rng(3).standard_normal(shown.shape) * [row.noise for row in twin.outputs]
    load = run(machine, np.column_stack([values[:, 0], shown])).last.parameters["T_load"]
    assert abs(float(load.value or 0.0) - held) <= 2.0 * QUANTILE * float(load.sd or 0.0)


def test_friction_in_place_of_an_input_is_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, plain(), more='[signals]\nT_load = { unknown = "friction" }')
    with raises_saying(ConfigurationError, "signals.T_load.unknown", "friction", "slow"):
        load_machine(path, with_driver=False)


def test_it_is_not_exported_again(tmp_path: Path) -> None:
    machine = load_machine(write_machine(tmp_path, plain()), with_driver=False)
    with raises_saying(ValueError, "FMU"):
        exported_twin(Posterior.initial(machine.problem))


@pytest.mark.parametrize("where", ["equations", "definitions"])
def test_a_twin_file_cannot_call_an_fmu(where: str) -> None:
    text = (LIBRARY / "dc_motor.toml").read_text(encoding="utf-8")
    if where == "equations":
        text = re.sub('"der\\(i\\)" = .*', '"der(i)" = "fmu(0, i)"', text)
    else:
        text = text.replace("[equations]", '[definitions]\nextra = "fmu(0, i)"\n[equations]')
    with raises_saying(ConfigurationError, "fmu", "not a function of the language"):
        read_twin(SourceFile(Path("twin.toml"), text))
