"""What an FMU says of itself: its description, read by FMPy and refused by name where a twin cannot be made of it."""

import io
import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from otolith.fmu.archive import DESCRIPTION, FmuArchive, check_binary, read_archive
from otolith_drivers.errors import installation_of
from otolith_drivers.outside_text import visible
from otolith_drivers.units import UnitNameError, base_exponents, to_base

MAX_TEXT = 120  # characters of a meaning
SAME_FACTOR = 1e-6  # relative difference up to which two factors of one unit are one
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
CHANGING = ("continuous", "discrete")
REALS = {"2": ("Real",), "3": ("Float64",)}
STEP = 1e-3
"""Engineering choice, in s: step of a trial of an FMU for co-simulation that states none."""


@dataclass(frozen=True, slots=True)
class DescribedVariable:
    """A real variable of an FMU."""

    name: str
    reference: int
    causality: str
    variability: str
    initial: str  # How its start value is found: "exact" if it can be set
    meaning: str
    unit: str  # As pint reads it; empty if the FMU states none, or one that cannot be read
    unit_fault: str  # Why its unit cannot be used; empty if it can, or if it states none
    start: float  # NaN if it states none
    low: float  # -inf if it states none
    high: float
    nominal: float  # NaN if it states none


@dataclass(frozen=True, slots=True)
class FmuDescription:
    """What a twin needs to know of an FMU."""

    archive: FmuArchive
    version: str  # "2" or "3"
    name: str
    text: str  # Its description
    tool: str
    identifier: str
    token: str
    is_model: bool  # For model exchange; otherwise for co-simulation
    is_stepped: bool  # Whether its rates cannot be read, so that it must make steps
    step: float  # s: of its steps in a trial
    own_step: float  # s: it makes steps of whole multiples of it; 0 if of any length
    has_slopes: bool  # Whether it offers directional derivatives
    has_states: bool  # Whether its whole state can be read and set
    indicators: int
    variables: dict[str, DescribedVariable]
    states: tuple[str, ...]  # In the order of the FMU; of one that is stepped: those whose start values can be set
    rates: tuple[str, ...]  # Of the states; none of one that is stepped

    def of(self, causality: str, *variabilities: str) -> list[DescribedVariable]:
        """Return the variables of a causality, and of some variabilities if they are given."""
        return [
            row
            for row in self.variables.values()
            if row.causality == causality and (not variabilities or row.variability in variabilities)
        ]


def read_fmu(path: Path) -> FmuDescription:
    """Return what the FMU at ``path`` says of itself; nothing of it runs.

    Raises:
        ValueError: it is no FMU, a hostile or a broken one, or none that a twin can be made of; with the reason.
    """
    archive = read_archive(path)
    model = _model(archive)
    version = str(model.fmiVersion)[:1]
    own, is_model = model.modelExchange or model.coSimulation, model.modelExchange is not None
    if own is None:
        raise ValueError("is neither for model exchange nor for co-simulation")
    variables = {row.name: row for row in model.modelVariables}
    check_binary(archive, version, str(own.modelIdentifier))
    units = {row.name: row for row in model.unitDefinitions}
    rates = [item.variable for item in model.derivatives]
    states = [rate.derivative for rate in rates]
    if any(state is None for state in states):
        raise ValueError(f"{DESCRIPTION}: one of its derivatives does not say of which state it is")
    is_stepped = not is_model and not (states and all(row.initial == "exact" for row in states))
    if is_stepped:
        rates, states = [], [row for row in variables.values() if row.type in REALS[version] and _can_be_state(row)]
    if not states and is_model:
        raise ValueError("has no continuous states: a twin is a system of differential equations")
    slopes = (getattr(own, f"providesDirectionalDerivative{ending}", False) for ending in ("", "s"))
    described = {row.name: _described(row, units) for row in variables.values() if row.type in REALS[version]}
    if not all(row.name in described for row in (*states, *rates)):
        raise ValueError(f"{DESCRIPTION}: one of its states is no number of double precision")
    step, own_step = _steps(model) if is_stepped else (0.0, 0.0)
    return FmuDescription(
        archive=archive,
        version=version,
        name=_plain(model.modelName),
        text=_plain(model.description),
        tool=_plain(model.generationTool),
        identifier=str(own.modelIdentifier),
        token=str(model.guid),
        is_model=is_model,
        is_stepped=is_stepped,
        step=step,
        own_step=own_step,
        has_slopes=is_model and any(_is_true(item) for item in slopes),
        has_states=_is_true(own.canGetAndSetFMUstate),
        indicators=int(model.numberOfEventIndicators or 0) if version == "2" else len(model.eventIndicators),
        variables=described,
        states=tuple(state.name for state in states),
        rates=tuple(rate.name for rate in rates),
    )


def _can_be_state(row: Any) -> bool:
    """Whether a variable may be a state of an FMU that does not say which are: one whose start value can be set."""
    return row.causality in ("output", "local") and row.initial == "exact" and row.variability in CHANGING


def _steps(model: Any) -> tuple[float, float]:
    """Return the step of a trial and the FMU's own step, both in s."""
    own, default = model.coSimulation, model.defaultExperiment
    internal = _number(own.fixedInternalStepSize, 0.0)
    step = internal or _number(default.stepSize if default else None, 0.0)
    step = step if 0.0 < step < math.inf else STEP
    return step, 0.0 if _is_true(own.canHandleVariableCommunicationStepSize) else step


def _model(archive: FmuArchive) -> Any:
    """Return FMPy's description of an archive; raises as :func:`read_fmu`."""
    try:
        import fmpy  # noqa: PLC0415 - an optional library, which only such a twin needs
    except ImportError as error:
        raise ValueError(f"needs FMPy: {installation_of('fmi')}") from error
    if re.search(rb"<!DOCTYPE|<!ENTITY", archive.description, re.IGNORECASE):
        raise ValueError(f"{DESCRIPTION} declares entities, which no FMU needs")
    start = re.search(rb'fmiVersion\s*=\s*["\']([^"\']{1,20})', archive.description)
    version = start[1].decode(errors="replace") if start else ""
    if not re.match(r"2\.0|3\.", version):
        raise ValueError(f"{DESCRIPTION}: is of FMI {visible(version)!r}: versions 2.0 and 3.0 can be used")
    alone = io.BytesIO()
    with zipfile.ZipFile(alone, "w") as copy:
        copy.writestr(DESCRIPTION, archive.description)
    try:
        return fmpy.read_model_description(alone, validate=True)
    except Exception as error:  # FMPy and lxml raise errors of many types, also of bare texts
        problems = getattr(error, "problems", None) or [str(error) or type(error).__name__]
        raise ValueError(f"{DESCRIPTION} is wrong: {visible(str(problems[0]), 300)}") from error


def _described(row: Any, units: dict[str, Any]) -> DescribedVariable:
    kind = row.declaredType
    unit, fault = _unit(row.unit or getattr(kind, "unit", None), units)
    if getattr(row, "dimensions", None):
        fault = fault or "is an array"
    return DescribedVariable(
        name=row.name,
        reference=int(row.valueReference),
        causality=str(row.causality),
        variability=str(row.variability),
        initial=str(row.initial or ""),
        meaning=_plain(row.description)[:MAX_TEXT],
        unit=unit,
        unit_fault=fault,
        start=_number(row.start, math.nan),
        low=_number(row.min if row.min is not None else getattr(kind, "min", None), -math.inf),
        high=_number(row.max if row.max is not None else getattr(kind, "max", None), math.inf),
        nominal=_number(row.nominal if row.nominal is not None else getattr(kind, "nominal", None), math.nan),
    )


def _unit(name: str | None, units: dict[str, Any]) -> tuple[str, str]:
    """Return the unit of a variable, and why it cannot be used; both empty if it states none."""
    if not name:
        return "", ""
    stated = getattr(units.get(name), "baseUnit", None)
    base = {} if stated is None else {key: _number(getattr(stated, key), 0.0) for key in BASE_UNITS}
    known = None if stated is None else _exponents(base)
    factor, offset = (1.0, 0.0) if stated is None else (_number(stated.factor, 1.0), _number(stated.offset, 0.0))
    shown = repr(visible(name, 40))
    try:
        scale, shift = to_base(name)
        exponents = _exponents(base_exponents(name))
    except (UnitNameError, ValueError):
        if known is None or factor != 1.0 or offset != 0.0:
            return "", f"its unit {shown} is not known"
        return "*".join(f"{key}^({value:g})" for key, value in base.items() if value) or "1", ""
    if offset or shift:
        return "", f"its unit {shown} has an offset, so equations cannot use it"
    if known is not None and (known != exponents or abs(factor - scale) > SAME_FACTOR * abs(scale)):
        return "", f"its unit {shown} is not what its base units state"
    return name, ""


def _exponents(of: dict[str, float]) -> dict[str, float]:
    """Return exponents without zeros and without the radian, which many tools leave out."""
    return {key: value for key, value in of.items() if value and key != "rad"}


def _number(text: object, default: float) -> float:
    try:
        return default if text is None else float(str(text))
    except ValueError:
        return default


def _is_true(text: object) -> bool:
    return str(text).lower() in ("true", "1")


def _plain(text: object) -> str:
    return visible(str(text or ""), 10 * MAX_TEXT)
