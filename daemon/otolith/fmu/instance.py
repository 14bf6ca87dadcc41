"""A loaded FMU: its binary, one instance of its model, and the table by which compiled kernels call it.

A kernel evaluates the FMU at any point, so nothing of a trajectory is kept in it: an evaluation sets all states, inputs
and parameters anew. Where an instance reports an error, another one replaces it.
"""

import ctypes
import logging
import os
import weakref
from collections.abc import Collection
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otolith.fmu import calls
from otolith.fmu.archive import held, unpacked
from otolith.fmu.reference import FmuReference
from otolith.fmu.trial import try_fmu
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.outside_text import visible

log = logging.getLogger(__name__)

FATAL = 4  # status fmi2Fatal and fmi3Fatal: the library must not be called again
MAX_MESSAGE = 300  # characters of what it logs
FUNCTIONS = {
    "2": {calls.SET_REALS: "SetReal", calls.GET_REALS: "GetReal"},
    "3": {calls.SET_REALS: "SetFloat64", calls.GET_REALS: "GetFloat64"},
}
OF_MODELS = {
    "2": {calls.GET_RATES: "GetDerivatives", calls.UPDATE: "NewDiscreteStates"},
    "3": {calls.GET_RATES: "GetContinuousStateDerivatives", calls.UPDATE: "UpdateDiscreteStates"},
}
"""C functions by the version of FMI, and by the entry of the table; those below have one name in both versions."""
OF_STEPPED = {
    "2": {calls.RESTORE: "SetFMUstate", calls.SET_UP: "SetupExperiment"},
    "3": {calls.RESTORE: "SetFMUState"},
}
OF_ALL_STEPPED = {
    calls.RESET: "Reset",
    calls.INITIALISE: "EnterInitializationMode",
    calls.BEGIN: "ExitInitializationMode",
    calls.DO_STEP: "DoStep",
}
OF_ALL_MODELS = {
    calls.SET_STATES: "SetContinuousStates",
    calls.ENTER_EVENTS: "EnterEventMode",
    calls.ENTER_CONTINUOUS: "EnterContinuousTimeMode",
}

Column = NDArray[np.float64]


class FmuInstance:
    """A model of an FMU that kernels can evaluate."""

    def __init__(self, reference: FmuReference, start: float = 0.0) -> None:
        """Raise ConfigurationError if the FMU cannot be loaded or refuses to start, at a time (s)."""
        self.reference, self._start = reference, start
        self._table = np.zeros(calls.ENTRIES, dtype=np.int64)
        self._buffers: list[NDArray[Any]] = []  # They must live as long as their addresses
        width, height = len(reference.arguments), len(reference.rows)
        self._fault = "the FMU reported a fatal error"  # Why it must not be called any more, once its status says so
        self._arguments, self._slopes = np.zeros(width), np.zeros(width * height)
        self._wanted = np.zeros(len(reference.parameters) or 1, dtype=np.uint8)
        try:
            folder = unpacked(reference)
            weakref.finalize(self, os.close, held(folder)).atexit = False
            self._own = _model(reference, folder)
            weakref.finalize(self, _free, reference.version, self._own, self._table).atexit = False
            self._fill_table()
            self._begin()
        except Exception as error:  # FMPy raises errors of many types, also of the operating system
            self._table[calls.INSTANCE] = 0  # it may be in a state in which it must not be freed
            text = visible(str(error) or type(error).__name__, MAX_MESSAGE)
            raise ConfigurationError(f"{reference.path}: the FMU does not start: {text}") from error

    @property
    def _reals(self) -> NDArray[np.float64]:
        """The table as numbers of double precision."""
        return self._table.view(np.float64)

    @property
    def address(self) -> float:
        """The address of the table, which a float holds exactly: addresses have at most 52 bits."""
        return float(self._table.ctypes.data)

    def want(self, parameters: Collection[int]) -> None:
        """Compute slopes by these parameters, given by their numbers, and by no others."""
        self._wanted[:] = [number in parameters for number in range(len(self._wanted))]

    def recover(self) -> None:
        """Replace the instance if it has reported an error; raise RuntimeError if it must not be called again."""
        status = int(self._table[calls.STATUS])
        if status >= FATAL:
            raise RuntimeError(f"{self.reference.path}: {self._fault}: it must be mended")
        if status >= calls.FAILED:
            log.warning("%s: the FMU reported an error and is instantiated anew", self.reference.path)
            self._table[calls.STATUS] = FATAL  # kernels call nothing while there is no instance, or if none starts
            self._table[calls.INSTANCE] = 0
            getattr(self._own, f"fmi{self.reference.version}FreeInstance")(self._own.component)
            try:
                self._begin()
            except Exception as error:  # as at the start
                text = visible(str(error) or type(error).__name__, MAX_MESSAGE)
                self._fault = f"the FMU does not start again after an error: {text}"
                raise RuntimeError(f"{self.reference.path}: {self._fault}: it must be mended") from error
        self._table[calls.STATUS] = 0

    def rows(
        self, arguments: Column, length: float | None = None, *, in_a_row: int = 1, is_late: bool = False
    ) -> Column:
        """Return rates and outputs (records, rows) for states, inputs and parameters (records, arguments).

        Both are in coherent units; NaN where the FMU cannot compute them. Of an FMU that is stepped, rates are the mean
        ones over ``in_a_row`` steps of a ``length`` (s, by default its own); the outputs are those at the beginning, or
        if ``is_late`` at the end.
        """
        own = arguments / np.array([item.scale for item in self.reference.arguments])
        self._reals[calls.LENGTH] = self.reference.step if length is None else length
        self._table[calls.IN_A_ROW], self._table[calls.IS_LATE] = in_a_row, is_late
        found = np.empty((len(own), len(self.reference.rows)))
        calls.sweep(self._table.ctypes.data, np.ascontiguousarray(own), found)
        self._table[calls.IN_A_ROW], self._table[calls.IS_LATE] = 1, 0
        self.recover()
        return np.asarray(found * np.array([item.scale for item in self.reference.rows]))

    def slopes(self, point: Column, *, by_differences: bool = False) -> Column:
        """Return the derivatives (rows, states and inputs) at a point (arguments,), in the FMU's own units.

        ``point`` is in coherent units; ``by_differences`` even where the FMU offers directional derivatives.
        """
        reference, offered = self.reference, int(self._table[calls.SLOPE])
        self._table[calls.SLOPE] = 0 if by_differences else offered
        self._arguments[:] = point / np.array([item.scale for item in reference.arguments])
        calls.differentiate(self._table.ctypes.data, calls.OF_STATES + calls.OF_INPUTS)
        self._table[calls.SLOPE] = offered
        self.recover()
        known = len(reference.states) + len(reference.inputs)
        return np.array(self._slopes.reshape(len(reference.rows), -1)[:, :known])

    def set_time(self, time: float) -> None:
        """Set the time of the model, s."""
        if self.reference.is_model:
            self._own.setTime(time)

    def _fill_table(self) -> None:
        reference, table, version = self.reference, self._table, self.reference.version
        names = dict(FUNCTIONS[version])
        if reference.is_model:
            names |= OF_MODELS[version] | OF_ALL_MODELS
        if reference.is_stepped:
            names |= OF_STEPPED[version] | OF_ALL_STEPPED
        if reference.has_slopes:
            names[calls.SLOPE] = "GetDirectionalDerivative"
        for number, name in names.items():
            function = getattr(self._own.dll, f"fmi{version}{name}")
            table[number] = ctypes.cast(function, ctypes.c_void_p).value or 0
        table[calls.IS_THIRD], table[calls.IS_MODEL] = version == "3", reference.is_model
        table[calls.IS_STEPPED], table[calls.IN_A_ROW] = reference.is_stepped, 1
        self._reals[calls.START], self._reals[calls.LENGTH] = self._start, reference.step
        self._reals[calls.OWN_STEP] = reference.own_step
        table[calls.END_AT] = self._kept(np.zeros(2 * len(reference.states)))
        groups = (reference.states, reference.inputs, reference.parameters, reference.outputs)
        for number, group in zip((calls.STATES, calls.INPUTS, calls.PARAMETERS, calls.OUTPUTS), groups, strict=True):
            table[number] = len(group)
        for number, group in ((calls.SET_AT, reference.arguments), (calls.ROW_AT, reference.rows)):
            table[number] = self._kept(np.array([item.reference for item in group], dtype=np.uint32))
        height = len(reference.rows)
        table[calls.ARGUMENTS_AT], table[calls.SLOPES_AT] = self._kept(self._arguments), self._kept(self._slopes)
        table[calls.ROWS_AT], table[calls.COLUMN_AT] = self._kept(np.zeros(height)), self._kept(np.zeros(height))
        table[calls.SIZES_AT] = self._kept(np.array([item.size for item in reference.arguments]))
        table[calls.SEED_AT] = self._kept(np.ones(1))
        table[calls.WANTED_AT] = self._kept(self._wanted)
        table[calls.EVENT_AT] = self._kept(np.zeros(calls.EVENT_BYTES, dtype=np.uint8))

    def _kept(self, buffer: NDArray[Any]) -> int:
        self._buffers.append(buffer)
        return int(buffer.ctypes.data)

    def _begin(self) -> None:
        """Instantiate the model and bring it into the mode in which rates are computed."""
        own, is_third = self._own, self.reference.version == "3"
        own.instantiate(**_instantiation(self.reference.version))
        if not is_third:
            own.setupExperiment(startTime=self._start)
        own.enterInitializationMode(**({"startTime": self._start} if is_third else {}))
        self._table[calls.INSTANCE] = ctypes.cast(own.component, ctypes.c_void_p).value or 0
        self._table[calls.SAVED] = 0
        if self.reference.can_restore:
            self._table[calls.SAVED] = own.getFMUState().value or 0
        if not self.reference.is_model:
            return  # the mode in which start values are set, and what follows from them is read
        own.exitInitializationMode()
        if calls.update(self._table.ctypes.data) >= calls.FAILED:
            raise ValueError("its discrete states cannot be updated")
        own.enterContinuousTimeMode()


@lru_cache(maxsize=8)
def instance_of(reference: FmuReference) -> FmuInstance:
    """Return the instance of this process; raises as :func:`try_fmu`, and as :class:`FmuInstance`.

    An instance that is no longer among the latest is freed when no kernel uses it any more.
    """
    try_fmu(reference)
    return FmuInstance(reference)


def _free(version: str, own: Any, table: NDArray[np.int64]) -> None:
    """Free the instance of a model that nobody uses any more, unless nothing of it may be called."""
    if table[calls.INSTANCE] and table[calls.STATUS] < FATAL:
        getattr(own, f"fmi{version}FreeInstance")(own.component)


def _model(reference: FmuReference, folder: Path) -> Any:
    """Return FMPy's model of the unpacked FMU, not yet instantiated."""
    from fmpy import fmi2, fmi3  # noqa: PLC0415 - an optional library, which only such a twin needs

    kinds = {
        ("2", True): fmi2.FMU2Model,
        ("2", False): fmi2.FMU2Slave,
        ("3", True): fmi3.FMU3Model,
        ("3", False): fmi3.FMU3Slave,
    }
    return kinds[reference.version, reference.is_model](
        guid=reference.token,
        unzipDirectory=str(folder),
        modelIdentifier=reference.identifier,
        instanceName="twin",
    )


def _instantiation(version: str) -> dict[str, Any]:
    """Return FMPy's options with a logger of our own: FMPy's prints what the FMU says, which is text from outside."""
    from fmpy import calloc, fmi2, free  # noqa: PLC0415 - an optional library, which only such a twin needs

    if version == "3":
        return {"logMessage": lambda _environment, _status, _category, message: _log(message)}
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda _environment, _name, _status, _category, text: _log(text))
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    return {"callbacks": callbacks}


def _log(message: bytes | None) -> None:
    log.debug("the FMU says: %s", visible((message or b"").decode(errors="replace"), MAX_MESSAGE))
