"""Exported FMUs, and how an importer drives them: FMPy, which is the reference of the tests."""

import ctypes
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave
from scipy.integrate import solve_ivp

from otolith.acquisition.window import Array
from otolith.estimation.posterior import Posterior
from otolith.exchange.exported import exported_twin
from otolith.exchange.fmu import Stepping, fmu_files
from otolith.exchange.model_description import Version
from otolith.runtime.fmu_archive import fmu_archive
from otolith.simulation.simulate import substeps_of
from tests.exchange.driven import Driven
from tests.simulation.motors import PERIOD


def write_fmu(state: Posterior, version: Version, folder: Path, name: str = "machine", note: str = "a note") -> Path:
    """Export the twin into a new file of ``folder``."""
    parts = fmu_files(exported_twin(state), (note,), version, Stepping(PERIOD, substeps_of(state)), name)
    path = folder / f"{parts.identifier}-{version}.fmu"
    path.write_bytes(fmu_archive(parts))
    return path


class Importer:
    """An FMU for co-simulation that was instantiated, by the names of its variables."""

    def __init__(self, path: Path, folder: str, *, is_model: bool = False) -> None:
        self.description: Any = read_model_description(str(path))
        self.references = {item.name: item.valueReference for item in self.description.modelVariables}
        self.is_third = self.description.fmiVersion.startswith("3")
        self._inputs: Callable[[float], dict[str, float]] | None = None
        kinds = {(True, True): FMU3Model, (True, False): FMU3Slave, (False, True): FMU2Model, (False, False): FMU2Slave}
        self.own: Any = kinds[self.is_third, is_model](
            guid=self.description.guid,
            unzipDirectory=extract(str(path), unzipdir=folder),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="tested",
        )

    def start(self, begin: float = 0.0, *, interpolates: bool = False, **values: float) -> None:
        """Instantiate and initialise it at a time, s."""
        if self.is_third:
            continuous = [
                item.valueReference
                for item in self.description.modelVariables
                if item.causality == "input" and item.variability == "continuous"
            ]
            wanted = (ctypes.c_uint32 * len(continuous))(*continuous)
            more = {"intermediateUpdate": self._asked, "requiredIntermediateVariables": wanted} if interpolates else {}
            self.own.instantiate(**more)
        else:
            self.own.instantiate()
        self.initialise(begin, **values)

    def initialise(self, begin: float = 0.0, **values: float) -> None:
        """Initialise it at a time, s."""
        if not self.is_third:
            self.own.setupExperiment(startTime=begin)
        self.put(**values)
        if self.is_third:
            self.own.enterInitializationMode(startTime=begin)
        else:
            self.own.enterInitializationMode()
        self.own.exitInitializationMode()

    def put(self, **values: float) -> None:
        """Set variables."""
        references = [self.references[name] for name in values]
        (self.own.setFloat64 if self.is_third else self.own.setReal)(references, list(values.values()))

    def get(self, *names: str) -> list[float]:
        """Return the values of variables."""
        references = [self.references[name] for name in names]
        found: list[float] = (self.own.getFloat64 if self.is_third else self.own.getReal)(references)
        return found

    def step(self, begin: float, length: float) -> None:
        """Let time go on by ``length`` s."""
        self.own.doStep(begin, length)

    def ramp(self, begin: float, length: float, now: dict[str, float], following: dict[str, float]) -> None:
        """Let time go on while inputs go along a line to their ``following`` values."""
        slopes = {name: (following[name] - now[name]) / length for name in now}
        if self.is_third:
            self._inputs = lambda time: {name: now[name] + slopes[name] * (time - begin) for name in now}
        elif slopes:
            count = len(slopes)
            references = (ctypes.c_uint32 * count)(*(self.references[name] for name in slopes))
            orders, values = (ctypes.c_int * count)(*[1] * count), (ctypes.c_double * count)(*slopes.values())
            self.own.fmi2SetRealInputDerivatives(self.own.component, references, count, orders, values)
        self.step(begin, length)

    def _asked(self, _: Any, time: float, *__: Any) -> None:
        if self._inputs is not None:
            self.put(**self._inputs(time))


@contextmanager
def imported(path: Path, *, is_model: bool = False) -> Iterator[Importer]:
    """Yield the FMU for co-simulation, or for model exchange; it is freed and its files are deleted at the end."""
    with tempfile.TemporaryDirectory() as folder:
        importer = Importer(path, folder, is_model=is_model)
        yield importer
        importer.own.freeInstance()


def co_simulated(path: Path, driven: Driven, begin: float = 0.0) -> Array:
    """Return the outputs (records, outputs) with inputs that are held or interpolated as in the kernel."""
    inputs, outputs = driven.state.problem.base_model.inputs, driven.state.problem.base_model.outputs
    found = []
    with imported(path) as fmu:
        fmu.start(begin, interpolates=True)
        for record, time in enumerate(driven.times.tolist()):
            now = {name: float(column[record]) for name, column in driven.columns.items()}
            fmu.put(**now)
            found.append(fmu.get(*(item.name for item in outputs)))
            if record + 1 < len(driven.times):
                linear = {item.name: now[item.name] for item in inputs if item.hold == "foh"}
                following = {name: float(driven.columns[name][record + 1]) for name in linear}
                fmu.ramp(begin + time, float(driven.times[record + 1] - time), linear, following)
    return np.array(found)


def model_exchanged(path: Path, driven: Driven) -> Array:
    """Return the outputs (records, outputs) by an accurate solver of the importer: that of SciPy."""
    inputs, outputs = driven.state.problem.base_model.inputs, driven.state.problem.base_model.outputs
    held = [item.name for item in inputs if item.hold == "zoh"]
    found = []
    with imported(path, is_model=True) as fmu:
        fmu.start()
        count = fmu.description.numberOfContinuousStates
        values = (ctypes.c_double * count)()
        derivatives = fmu.own.getContinuousStateDerivatives if fmu.is_third else fmu.own.getDerivatives
        fmu.own.getContinuousStates(values, count)

        def put(time: float, state: Array, *, in_event: bool = False) -> None:
            fmu.own.setTime(time)
            values[:] = state.tolist()
            fmu.own.setContinuousStates(values, count)
            now = {name: float(np.interp(time, driven.times, column)) for name, column in driven.columns.items()}
            fmu.put(**{name: value for name, value in now.items() if in_event or name not in held})

        def rates(time: float, state: Array) -> Array:
            put(time, state)
            derivatives(values, count)
            return np.array(values)

        state = np.array(values)
        for record, time in enumerate(driven.times.tolist()):
            if record:
                fmu.own.enterEventMode()
            put(time, state, in_event=True)
            (fmu.own.updateDiscreteStates if fmu.is_third else fmu.own.newDiscreteStates)()
            found.append(fmu.get(*(item.name for item in outputs)))
            fmu.own.enterContinuousTimeMode()
            if record + 1 < len(driven.times):
                ends = (time, float(driven.times[record + 1]))
                state = solve_ivp(rates, ends, state, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    return np.array(found)
