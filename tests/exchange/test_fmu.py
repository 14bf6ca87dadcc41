"""An exported FMU is the twin: FMPy and libcosim get the trajectories of the kernel from it."""

import re
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from fmpy.validation import validate_fmu
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
from libcosimpy.CosimManipulator import CosimManipulator
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave

from otolith.acquisition.window import Array
from otolith.estimation.posterior import Posterior
from otolith.exchange.model_description import Version
from otolith.machine import library_twins
from otolith.runtime import fmu_archive
from otolith_drivers.errors import ConfigurationError
from tests.exchange.driven import COMPONENTS, Driven, awkward_state, completed
from tests.exchange.fmus import co_simulated, imported, model_exchanged, write_fmu
from tests.hostile import HOSTILE
from tests.messages import assert_says, raises_saying
from tests.simulation.motors import PERIOD, library_state
from tests.variants import often, often_rows

TOLERANCE = 1e-6  # of the largest value of an output
STATES: dict[str, Callable[[], Posterior]] = {
    **{name: partial(library_state, name) for name in library_twins()},
    **{f"components {index}": partial(completed, row) for index, row in enumerate(COMPONENTS)},
    "awkward names": awkward_state,
}
ALL = [(name, version) for name in STATES for version in Version]
OFTEN = [("dc_motor", Version.TWO), ("components 1", Version.THREE), ("awkward names", Version.THREE)]


def assert_same(found: Array, expected: Array) -> None:
    """Assert that trajectories (records, outputs) are the same to a millionth."""
    assert np.isfinite(expected).all()
    error = np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)
    assert (error <= TOLERANCE).all(), error


@pytest.mark.parametrize(("name", "version"), often_rows(OFTEN, ALL))
def test_co_simulation_is_the_kernel(name: str, version: Version, tmp_path: Path) -> None:
    driven = Driven(STATES[name]())
    assert_same(co_simulated(write_fmu(driven.state, version, tmp_path), driven), driven.exact)


@pytest.mark.parametrize(("name", "version"), often_rows(OFTEN, ALL))
def test_model_exchange_has_the_same_solution(name: str, version: Version, tmp_path: Path) -> None:
    driven = Driven(STATES[name]())
    assert_same(model_exchanged(write_fmu(driven.state, version, tmp_path), driven), driven.solution)


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("version", Version)
def test_an_importer_simulates_it_by_itself(version: Version, kind: str, tmp_path: Path) -> None:
    """With steps of a command, and its own solver in model exchange."""
    driven = Driven(completed(COMPONENTS[0]))
    driven.columns["T_load"][:] = 0.02
    names = ["time", *driven.columns]
    rows = list(zip(driven.times, *driven.columns.values(), strict=True))
    result = simulate_fmu(
        str(write_fmu(driven.state, version, tmp_path)),
        fmi_type=kind,
        relative_tolerance=1e-9,
        stop_time=float(driven.times[-1]),
        output_interval=PERIOD,
        input=np.array(rows, dtype=[(name, np.double) for name in names]),
        output=["i", "omega"],
        record_events=False,
    )
    assert_same(np.column_stack([result["i"], result["omega"]]), driven.solution)


def test_another_importer_gets_the_same(tmp_path: Path) -> None:
    """That is libcosim, which is written in C++ upon the FMI Library, and imports FMI 2.0 for co-simulation."""
    driven = Driven(completed(COMPONENTS[0]))
    driven.columns["T_load"][:] = 0.02
    log_output_level(CosimLogLevel.ERROR)
    slave = CosimLocalSlave(fmu_path=str(write_fmu(driven.state, Version.TWO, tmp_path)), instance_name="motor")
    execution = CosimExecution.from_step_size(step_size=PERIOD * 1e9)
    index = execution.add_local_slave(slave)
    setting, seen = CosimManipulator.create_override(), CosimObserver.create_last_value()
    execution.add_manipulator(setting)
    execution.add_observer(seen)
    references = {item.name.decode(): item.reference for item in execution.slave_variables(index)}
    found = []
    for record in range(len(driven.times) - 1):
        values = [float(column[record]) for column in driven.columns.values()]
        setting.slave_real_values(index, [references[name] for name in driven.columns], values)
        assert execution.step()
        found.append(seen.last_real_values(index, [references["i"], references["omega"]]))
    assert_same(np.array(found), driven.exact[1:])


@pytest.mark.parametrize("version", Version)
@pytest.mark.parametrize("name", STATES)
def test_the_description_is_valid(name: str, version: Version, tmp_path: Path) -> None:
    state = STATES[name]()
    path = write_fmu(state, version, tmp_path)
    assert validate_fmu(str(path)) == []
    description = read_model_description(str(path), validate=True)
    rows = {item.name: item for item in description.modelVariables}
    assert len(rows) == len(description.modelVariables)
    twin = state.problem.base_model
    for item in twin.parameters:
        row = rows[item.name]
        known = dict(state.problem.known).get(item.name, item.nominal)
        assert (row.causality, row.variability, float(row.start), row.unit) == (
            "parameter",
            "tunable",
            known,
            item.unit,
        )
        assert_says(row.description, item.meaning)
    units = {unit.name: unit.baseUnit for unit in description.unitDefinitions}
    assert {row.unit for row in rows.values() if row.unit} <= units.keys()
    for driven in twin.inputs:
        assert rows[driven.name].variability == ("discrete" if driven.hold == "zoh" else "continuous")
    assert {item.name for item in description.modelVariables if item.causality == "output"} == {
        item.name for item in twin.outputs
    }


def test_units_are_those_of_the_standard(tmp_path: Path) -> None:
    path = write_fmu(library_state("pump"), Version.TWO, tmp_path)
    units = {unit.name: unit.baseUnit for unit in read_model_description(str(path)).unitDefinitions}
    pressure, flow, speed = units["kPa"], units["m^3/h"], units["rad/s"]
    assert (pressure.kg, pressure.m, pressure.s) == (1, -1, -2)
    assert (flow.m, flow.s) == (3, -1)
    assert [float(unit.factor) for unit in (pressure, flow)] == pytest.approx([1e3, 1 / 3600])
    assert (speed.rad, speed.s) == (1, -1)


@pytest.mark.parametrize("version", Version)
def test_a_component_is_a_parameter_with_its_name(version: Version, tmp_path: Path) -> None:
    path = write_fmu(completed(COMPONENTS[0]), version, tmp_path)
    rows = {item.name: item for item in read_model_description(str(path)).modelVariables}
    assert float(rows["shaft_periodic_amplitude"].start) == 0.005
    assert rows["shaft_periodic_amplitude"].unit == "N*m"
    assert_says(rows["shaft_periodic"].description, "shaft/periodic/angle(omega)", "sin")
    assert rows["winding_linear"].causality == "local"
    with imported(path) as fmu:
        fmu.start(shaft_periodic_amplitude=0.0, V_a=12.0)
        assert fmu.get("shaft_periodic") == [0.0]


@pytest.mark.parametrize("version", Version)
def test_a_parameter_is_tuned_and_a_state_comes_again(version: Version, tmp_path: Path) -> None:
    """Between two steps; a state that is set, or read back from its bytes, gives the same numbers again."""
    path = write_fmu(completed(COMPONENTS[1]), version, tmp_path)

    def going_on(begin: float = 2.0) -> list[float]:
        found = []
        for number in range(3):
            fmu.step(begin + number * PERIOD, PERIOD)
            found += fmu.get("i", "omega")
        return found

    with imported(path) as fmu:
        fmu.start(1.0, V_a=12.0, T_load=0.01)
        fmu.step(1.0, 1.0)
        own, third = fmu.own, fmu.is_third
        state = (own.getFMUState if third else own.getFMUstate)()
        bytes_ = (own.serializeFMUState if third else own.serializeFMUstate)(state)
        first = going_on()
        (own.setFMUState if third else own.setFMUstate)(state)
        assert going_on() == first
        again = (own.deserializeFMUState if third else own.deSerializeFMUstate)(bytes_)
        (own.setFMUState if third else own.setFMUstate)(again)
        fmu.put(R_a=7.0)
        assert going_on() != first
        assert fmu.get("R_a") == [7.0]
        own.reset()
        assert fmu.get("R_a") == [6.5]
        fmu.initialise(5.0, V_a=12.0, T_load=0.01)  # times count from the start of the experiment
        fmu.step(5.0, 1.0)
        assert going_on(6.0) == pytest.approx(first, rel=1e-9)
        for kept in (state, again):
            (own.freeFMUState if third else own.freeFMUstate)(kept)


@pytest.mark.parametrize("version", Version)
def test_what_cannot_be_is_an_error(version: Version, tmp_path: Path) -> None:
    with imported(write_fmu(awkward_state(), version, tmp_path)) as fmu:
        fmu.start()
        set_values = fmu.own.setFloat64 if fmu.is_third else fmu.own.setReal
        for reference in (fmu.references["end__"], fmu.references["elapsed"], 10_000):  # a constant, computed, none
            with pytest.raises(Exception, match="error"):
                set_values([reference], [1.0])
        for length in (-1.0, float("nan")):
            with pytest.raises(Exception, match="error"):
                fmu.step(0.0, length)
        fmu.put(indicator=-1e9)
        with pytest.raises(Exception, match="error"):
            fmu.step(0.0, 100.0)


@pytest.mark.parametrize("version", Version)
def test_a_switch_of_the_equations_is_an_event(version: Version, tmp_path: Path) -> None:
    """Dry friction with another level in each direction changes where the velocity does."""
    path = write_fmu(library_state("servo_axis_directional"), version, tmp_path)
    description = read_model_description(str(path))
    assert description.numberOfEventIndicators == 1
    signals = np.array([(0.0, 120.0), (0.5, -120.0), (1.0, -120.0)], dtype=[("time", np.double), ("F", np.double)])
    common = {"fmi_type": "ModelExchange", "input": signals, "output": ["state.v", "F_f"], "stop_time": 1.0}
    result = simulate_fmu(str(path), solver="CVode", relative_tolerance=1e-9, output_interval=0.1, **common)
    at = np.flatnonzero(np.diff(result["time"]) == 0.0)
    assert np.abs(result["time"][at] - 0.5).min() < 1e-9  # that of the input
    assert np.abs(result["state.v"][at]).min() < 1e-6  # that of the velocity


@pytest.mark.parametrize("version", Version)
@pytest.mark.parametrize("name", often(["pump", "awkward names", "components 2"], STATES))
def test_the_sources_compile_with_gcc_alone(name: str, version: Version, tmp_path: Path) -> None:
    path = write_fmu(STATES[name](), version, tmp_path, note="".join(HOSTILE[:-1]) + "*/ #error ??/\n\\\n#error")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "open")
    sources = tmp_path / "open" / "sources"
    command = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
    done = subprocess.run(
        [*command, version.source, "-o", "a.so", "-lm"], cwd=sources, capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
    shown = subprocess.run(
        [shutil.which("nm") or "nm", "-D", "--defined-only", "a.so"], cwd=sources, capture_output=True, check=True
    )
    assert all(line.split()[-1].startswith(f"fmi{version}") for line in shown.stdout.decode().splitlines())
    listed = sources / "buildDescription.xml" if version is Version.THREE else path_of_description(tmp_path)
    assert_says(listed.read_text(encoding="utf-8"), f'name="{version.source}"')


def path_of_description(folder: Path) -> Path:
    """Of an FMU that was unpacked."""
    return folder / "open" / "modelDescription.xml"


@pytest.mark.parametrize("version", Version)
def test_text_from_outside_stays_text(version: Version, tmp_path: Path) -> None:
    for index, text in enumerate((*HOSTILE[:-1], "\ufffe\uffff]]><x a='")):
        folder = tmp_path / str(index)
        folder.mkdir()
        if index % 4 and version is Version.TWO:
            continue  # compiles each: a quarter of them in this version
        path = write_fmu(library_state("dc_motor"), version, folder, name=text, note=text)
        assert validate_fmu(str(path)) == []
        assert re.fullmatch(
            r"otolith_\w{1,60}", read_model_description(str(path)).coSimulation.modelIdentifier, re.ASCII
        )


def test_the_same_twin_is_the_same_archive(tmp_path: Path) -> None:
    def made(state: Posterior, name: str) -> bytes:
        (tmp_path / name).mkdir()
        return write_fmu(state, Version.TWO, tmp_path / name).read_bytes()

    first = made(library_state("dc_motor"), "a")
    assert made(library_state("dc_motor"), "b") == first
    tokens = [
        read_model_description(str(path)).guid
        for path in (tmp_path / "a" / "otolith_machine-2.fmu", write_fmu(library_state("fan"), Version.TWO, tmp_path))
    ]
    assert tokens[0] != tokens[1]


def test_without_a_compiler_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with raises_saying(ConfigurationError, "C compiler", "PATH", "gcc"):
        write_fmu(library_state("dc_motor"), Version.TWO, tmp_path)
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho 'x.h: error: no such file' >&2\nexit 1\n", encoding="utf-8")
    broken.chmod(0o755)
    with raises_saying(ConfigurationError, str(broken), "x.h: error: no such file", "libc6-dev"):
        write_fmu(library_state("dc_motor"), Version.TWO, tmp_path)
    broken.write_text("#!/bin/sh\nexec sleep 60\n", encoding="utf-8")
    monkeypatch.setenv("PATH", f"{tmp_path}:{Path(shutil.which('sh', path='/bin:/usr/bin') or '').parent}")
    monkeypatch.setattr(fmu_archive, "TIMEOUT", 0.2)
    with raises_saying(ConfigurationError, str(broken), "timed out"):
        write_fmu(library_state("dc_motor"), Version.TWO, tmp_path)
