"""A twin whose equations are in an FMU: which variables it uses, under which names, in which units.

Its states are all those of the FMU, its inputs all inputs, its outputs all outputs or those that ``[twin.variables]``
names, and its parameters those of ``[parameters]``. Components enter at the inputs; the sensors have places of their
own, as in any twin.
"""

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from otolith.fmu.description import DescribedVariable, FmuDescription
from otolith.fmu.reference import FmuQuantity, FmuReference
from otolith.twin.definition import Definition, Input, Output, Parameter, Role, Site, StateVariable
from otolith.twin.expressions import FMU, MAX_LENGTH, check_name, describe, dimension_of
from otolith.twin.language import MAX_ROWS, Bounds, Unit, equation_faults
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import nearest
from otolith_drivers.units import Quantity, to_base

# Decisions. docs/reference/thresholds-twin.md gives the origin of each and the test that guards it.
WIDER = 10.0  # times the start value: bounds of a parameter for which neither the FMU nor the machine file states any
STATE_REACH = 1e3  # times the typical size of a state: bounds where the FMU states none
MAX_INPUT_NAME = 31  # characters: sites and definitions have its name with a prefix
ENTERING, PLACE = "entering_", "at_"  # before the name of an input: what drives the FMU, and the site there
TUNABLE = "tunable"

Fault = Callable[[tuple[str, ...], str], None]  # Raises an error that names a place of the machine file


def _expand(written: object) -> object:
    """Expand ``"motor.w"``, the short form of ``{ variable = "motor.w" }``."""
    return {"variable": written} if isinstance(written, str) else written


class VariableTable(StrictModel):
    """What a machine file states of a variable of an FMU."""

    variable: str | None = None  # Its name in the FMU; without it the same name
    unit: Unit | None = None  # Of the twin; needed if the FMU states none
    hold: Literal["zoh", "foh"] | None = None  # Of an input; without it as the FMU says
    bounds: Bounds | None = None  # Of a state; of an input its ordinary range
    measured: bool = True  # Of a state or an output: whether a sensor shows it
    derivative: str | None = None  # Of a position: the name of its speed, a state
    state: bool | None = None  # Of an FMU that is stepped: whether the future follows from it
    start: str | None = None  # Of such a state: name in the FMU of the variable that sets its start value


_Named = tuple[str, DescribedVariable]  # A variable with its name in the twin
Variables = dict[str, Annotated[VariableTable, BeforeValidator(_expand)]]
VARIABLES: Any = Field(default_factory=dict)


def twin_of_fmu(
    fmu: FmuDescription, tables: Mapping[str, VariableTable], parameters: Mapping[str, tuple[bool, bool]], fail: Fault
) -> Definition:
    """Return the twin of an FMU.

    ``parameters`` are those of the machine file, each with whether it has a lower and an upper bound there. ``fail``
    raises what is wrong with ``[twin.variables]`` or ``[parameters]``.
    """
    return _Maker(fmu, tables, parameters, fail).definition()


class _Maker:
    """Assigns the variables of an FMU to the quantities of a twin."""

    def __init__(
        self,
        fmu: FmuDescription,
        tables: Mapping[str, VariableTable],
        parameters: Mapping[str, tuple[bool, bool]],
        fail: Fault,
    ) -> None:
        self._fmu, self._tables, self._written, self._fail = fmu, tables, parameters, fail
        self._own: dict[str, str] = {}  # Names in the twin by those in the FMU
        self._states = self._chosen_states()
        self._rates = fmu.rates or self._states  # Of one that is stepped: the states at the end of a step
        for name, table in tables.items():
            self._claim(name, table)

    def definition(self) -> Definition:
        """Return the twin."""
        fmu = self._fmu
        states = [self._named(name) for name in self._states]
        inputs = [self._named(row.name) for row in fmu.of("input")]
        shown = self._outputs()
        parameters = [self._parameter_variable(name) for name in self._written]
        self._check_sizes({"states": states, "inputs": inputs, "outputs": shown, "parameters": parameters})
        units = {row.name: self._unit(name, row) for name, row in (*states, *inputs, *shown, *parameters)}
        computed = [pair for pair in shown if pair[1].name not in self._states]
        left = [*(f"der({name})" for name, _ in states), *(name for name, _ in computed)]
        given = [name for name, _ in states] + [f"{ENTERING}{name}" for name, _ in inputs]
        given += [name for name, _ in parameters]
        speeds = self._speeds([name for name, _ in states])
        twin = Definition(
            name=re.sub(r"^[^A-Za-z]+", "", _identifier(fmu.archive.path.stem))[:60] or "fmu",
            title=fmu.name or "a model of another tool",
            source=f"FMU {fmu.archive.path.name}" + (f", {fmu.tool}" if fmu.tool else ""),
            validity=fmu.text,
            states=tuple(self._state(name, row, units[row.name]) for name, row in states),
            inputs=tuple(self._input(name, row, units[row.name]) for name, row in inputs),
            outputs=tuple(Output(name, units[row.name], row.meaning or name, math.nan) for name, row in shown),
            parameters=tuple(self._parameter(name, row, units[row.name]) for name, row in parameters),
            equations=tuple(
                (side, speeds.get(side) or f"{FMU}({number}, {', '.join(given)})") for number, side in enumerate(left)
            ),
            definitions=tuple((f"{ENTERING}{name}", name, f"{name} with components") for name, _ in inputs),
            sites=tuple(_site(name, row, units[row.name]) for name, row in inputs),
            fmu=self._reference((states, inputs, parameters, computed), units, speeds),
        )
        if max(len(text) for _, text in twin.equations) > MAX_LENGTH:
            self._fail(("twin", "fmu"), f"its names have more than {MAX_LENGTH} characters: shorten some of them")
        if faults := equation_faults(twin):
            self._fail(("twin", "fmu"), faults[0])
        return twin

    def _reference(
        self, groups: Sequence[Sequence[_Named]], units: Mapping[str, str], speeds: Mapping[str, str]
    ) -> FmuReference:
        """Return what kernels need of the FMU; ``groups`` are states, inputs, parameters and outputs."""
        fmu, (states, inputs, parameters, computed) = self._fmu, groups

        def quantities(rows: Iterable[_Named]) -> tuple[FmuQuantity, ...]:
            return tuple(_quantity(row, row.unit or units[row.name]) for _, row in rows)

        numbers = {name: number for number, (name, _) in enumerate(states)}
        return FmuReference(
            path=str(fmu.archive.path.absolute()),
            digest=fmu.archive.digest,
            version=fmu.version,
            identifier=fmu.identifier,
            token=fmu.token,
            states=tuple(self._set_by(row, item) for (_, row), item in zip(states, quantities(states), strict=True)),
            inputs=quantities(inputs),
            parameters=quantities(parameters),
            rates=tuple(
                _quantity(fmu.variables[rate], state.unit or units[state.name])
                for rate, (_, state) in zip(self._rates, states, strict=True)
            ),
            outputs=quantities(computed),
            integrals=tuple(
                (numbers[name], numbers[speeds[f"der({name})"]]) for name in numbers if f"der({name})" in speeds
            ),
            has_slopes=fmu.has_slopes,
            is_model=fmu.is_model,
            is_stepped=fmu.is_stepped,
            can_restore=fmu.is_stepped and fmu.has_states,
            step=fmu.step,
            own_step=fmu.own_step,
        )

    def _chosen_states(self) -> tuple[str, ...]:
        """Return the states; of an FMU that is stepped those that the file names, or all with start values."""
        fmu = self._fmu
        stated = {table.variable or name: (name, table) for name, table in self._tables.items()}
        if not fmu.is_stepped:
            for own, table in stated.values():
                if table.state is not None or table.start is not None:
                    self._fail(("twin", "variables", own), "state and start are of an FMU that must make steps")
            return fmu.states
        named = tuple(name for name, (_, table) in stated.items() if table.state and name in fmu.variables)
        left = (name for name in fmu.states if name not in stated or stated[name][1].state is not False)
        found = named or tuple(left)
        for name in found:
            self._check_start(name, *stated.get(name, (name, VariableTable())))
        if not found:
            example = 'omega = { variable = "w", state = true, start = "w_start" }'
            self._fail(
                ("twin", "fmu"), f"is for co-simulation and does not show its states: write each, like {example}"
            )
        return found

    def _check_start(self, name: str, own: str, table: VariableTable) -> None:
        """Fail if nothing sets the start value of a state of an FMU that is stepped."""
        setting, key = table.start or name, ("twin", "variables", own)
        row = self._fmu.variables.get(setting)
        if row is None:
            known = nearest(setting, list(self._fmu.variables))
            self._fail((*key, "start"), f"the FMU has no such real variable: {known}")
        elif row.causality != "parameter" and row.initial not in ("exact", "approx"):
            remedy = f'{_identifier(name)} = {{ variable = "{name}", state = true, start = "the_variable" }}'
            self._fail(key, f"no start value of {setting!r} can be set: write the variable that sets it, like {remedy}")

    def _set_by(self, row: DescribedVariable, state: FmuQuantity) -> FmuQuantity:
        """Return what sets a state: its own variable, or that of its start value."""
        table = self._tables.get(self._own[row.name], VariableTable())
        if table.start is None:
            return state
        start = self._fmu.variables[table.start]
        if start.unit and row.unit and start.unit != row.unit:
            key = ("twin", "variables", self._own[row.name], "start")
            self._fail(key, f"{start.name!r} is in {start.unit!r}, but {row.name!r} in {row.unit!r}")
        return replace(state, reference=start.reference, start=state.start if math.isnan(start.start) else start.start)

    def _claim(self, name: str, table: VariableTable) -> None:
        """Give a variable the name of its table."""
        at, wanted = ("twin", "variables", name), table.variable or name
        if wanted not in self._fmu.variables:
            self._fail(at, f"the FMU has no such real variable: {nearest(wanted, list(self._fmu.variables))}")
        if wanted in self._own:
            self._fail(at, f"{wanted!r} has the name {self._own[wanted]!r} already: a variable has one name")
        try:
            check_name(name)
        except ValueError as error:
            self._fail(at, str(error))
        row = self._fmu.variables[wanted]
        if row.causality not in ("input", "output", "parameter") and wanted not in self._states:
            self._fail(at, f"{wanted!r} is neither a state nor an input, an output or a parameter of the FMU")
        self._own[wanted] = name

    def _named(self, variable: str) -> _Named:
        """Return the name of a variable in the twin, and the variable."""
        row = self._fmu.variables[variable]
        if variable not in self._own:
            name, taken = _identifier(variable), set(self._own.values())
            if not name or name in taken or not _is_name(name):
                remedy = f'[twin.variables] my_name = "{variable}"'
                self._fail(("twin", "fmu"), f"its variable {variable!r} needs a name in the twin: write {remedy}")
            self._own[variable] = name
        name = self._own[variable]
        if row.causality == "input" and len(name) > MAX_INPUT_NAME:
            self._fail(("twin", "fmu"), f"the input {name!r} has a name of more than {MAX_INPUT_NAME} characters")
        return name, row

    def _speeds(self, states: list[str]) -> dict[str, str]:
        """Return the speed of each position, by the left side of its equation: the FMU or a table says so."""
        fmu, found = self._fmu, dict[str, str]()
        if fmu.is_stepped:
            for name in states:
                if self._tables.get(name, VariableTable()).derivative:
                    key = ("twin", "variables", name, "derivative")
                    self._fail(key, "the FMU makes steps, so its derivatives are not seen: leave it out")
            return found
        references = {fmu.variables[state].reference: name for state, name in zip(fmu.states, states, strict=True)}
        for rate, name in zip(fmu.rates, states, strict=True):
            written = self._tables.get(name, VariableTable()).derivative
            if written is not None and (written not in states or written == name):
                key = ("twin", "variables", name, "derivative")
                self._fail(key, f"{written!r} is no other state of the FMU: {nearest(written, states)}")
            speed = written or references.get(fmu.variables[rate].reference)
            found |= {f"der({name})": speed} if speed else {}
        return found

    def _outputs(self) -> list[_Named]:
        """Return what sensors show: the outputs and states that tables name; without any all outputs."""
        fmu = self._fmu
        named = [
            (own, fmu.variables[variable])
            for variable, own in self._own.items()
            if own in self._tables
            and self._tables[own].measured
            and (fmu.variables[variable].causality == "output" or variable in self._states)
        ]
        found = named or [self._named(row.name) for row in fmu.of("output")]
        if not found:
            example = f'[twin.variables] {_identifier(self._states[0])} = "{self._states[0]}"'
            self._fail(("twin", "fmu"), f"has no outputs: name the states that sensors show, like {example}")
        return found

    def _parameter_variable(self, name: str) -> _Named:
        """Return a parameter of the machine file, and its variable."""
        tunable = self._fmu.of("parameter", TUNABLE, *(() if self._fmu.is_model else ("fixed",)))
        known = {self._own.get(row.name, _identifier(row.name)): row for row in tunable}
        if name not in known:
            fixed = {_identifier(row.name) for row in self._fmu.of("parameter", "fixed")}
            why = "a fixed one, which cannot change while it runs" if name in fixed else nearest(name, list(known))
            self._fail(("parameters", name), f"the FMU has no such tunable parameter: {why}")
        row = known[name]
        if row.name in {table.start for table in self._tables.values()}:
            self._fail(("parameters", name), "sets the start value of a state, so it is estimated with each window")
        if self._own.get(row.name, name) != name or (row.name not in self._own and name in self._own.values()):
            self._fail(("parameters", name), "is the name of another variable too: name it in [twin.variables]")
        self._own[row.name] = name
        return name, row

    def _unit(self, name: str, row: DescribedVariable) -> str:
        """Return the unit of a quantity in the twin."""
        table = self._tables.get(name, VariableTable())
        key = ("twin", "variables", name)
        if row.unit_fault:
            self._fail(key, f"{row.name!r} cannot be used: {row.unit_fault}")
        if table.unit is None:
            if not row.unit:
                example = f'{name} = {{ variable = "{row.name}", unit = "rad/s" }}'
                self._fail(key, f"the FMU states no unit of {row.name!r}: write it, like {example}")
            return row.unit
        if row.unit and dimension_of(row.unit) != dimension_of(table.unit):
            stated, written = (describe(dimension_of(unit)) for unit in (row.unit, table.unit))
            self._fail((*key, "unit"), f"{table.unit!r} is in {written}, but {row.name!r} of the FMU in {stated}")
        return table.unit

    def _bounds(self, name: str, row: DescribedVariable, unit: str) -> tuple[float, float]:
        """Return the bounds of a variable in the twin's unit, infinite if none are stated."""
        table = self._tables.get(name, VariableTable())
        if table.bounds is None:
            share = _scale(row.unit or unit) / _scale(unit)
            return row.low * share, row.high * share
        found = []
        for written in table.bounds:
            try:
                found.append(float(written) if isinstance(written, int | float) else Quantity(unit).convert(written))
            except ValueError as error:
                self._fail(("twin", "variables", name, "bounds"), str(error))
        low, high = found
        if not low < high:
            self._fail(("twin", "variables", name, "bounds"), f"{low:g} {unit} must be below {high:g} {unit}")
        return low, high

    def _state(self, name: str, row: DescribedVariable, unit: str) -> StateVariable:
        share = _scale(row.unit or unit) / _scale(unit)
        start = 0.0 if math.isnan(row.start) else row.start * share
        low, high = self._bounds(name, row, unit)
        reach = STATE_REACH * max(abs(start), _size(row) * share)
        low, high = max(low, -reach) if math.isinf(low) else low, min(high, reach) if math.isinf(high) else high
        return StateVariable(name, unit, row.meaning or name, min(max(start, low), high), low, high)

    def _input(self, name: str, row: DescribedVariable, unit: str) -> Input:
        low, high = self._bounds(name, row, unit)
        is_known = math.isfinite(low) and math.isfinite(high)
        hold = self._tables.get(name, VariableTable()).hold or ("zoh" if row.variability == "discrete" else "foh")
        ends = (low, high) if is_known else (-1.0, 1.0)
        return Input(name, unit, row.meaning or name, hold, *ends, has_range=is_known)

    def _parameter(self, name: str, row: DescribedVariable, unit: str) -> Parameter:
        if math.isnan(row.start):
            self._fail(("parameters", name), "the FMU states no value of it")
        share, (has_low, has_high) = _scale(row.unit or unit) / _scale(unit), self._written[name]
        value = row.start * share
        low, high = self._bounds(name, row, unit)
        if value == 0.0 and not ((math.isfinite(low) or has_low) and (math.isfinite(high) or has_high)):
            self._fail(("parameters", name), "the FMU states its value 0 and no bounds: write low and high")
        wide = sorted((value / WIDER, value * WIDER)) if value else [-1.0, 1.0]
        low, high = low if math.isfinite(low) else wide[0], high if math.isfinite(high) else wide[1]
        return Parameter(name, unit, value, low, high, row.meaning or name, Role.ESTIMATED)

    def _check_sizes(self, groups: Mapping[str, Collection[Any]]) -> None:
        for group, rows in groups.items():
            if len(rows) > MAX_ROWS[group]:
                self._fail(("twin", "fmu"), f"has {len(rows)} {group}: at most {MAX_ROWS[group]} are supported")


def _site(name: str, row: DescribedVariable, unit: str) -> Site:
    """Return the place where components enter with an input."""
    meaning = f"unknown part of {row.meaning or name}"
    return Site(f"{PLACE}{name}", unit, meaning, f"{ENTERING}{name}", "additive", part=name)


def _quantity(row: DescribedVariable, unit: str) -> FmuQuantity:
    start = 0.0 if math.isnan(row.start) else row.start
    return FmuQuantity(row.name, row.reference, _scale(unit), _size(row), start)


def _scale(unit: str) -> float:
    return to_base(unit)[0]


def _size(row: DescribedVariable) -> float:
    """Return the typical magnitude of a variable in its own unit."""
    sizes = (row.nominal, row.start, max(abs(row.low), abs(row.high)))
    return next((abs(size) for size in sizes if size and math.isfinite(size)), 1.0)


def _identifier(name: str) -> str:
    """Return a name of the FMU as one of the twin language: ``motor.R_a`` becomes ``motor_R_a``."""
    return re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")


def _is_name(name: str) -> bool:
    try:
        check_name(name)
    except ValueError:
        return False
    return True
