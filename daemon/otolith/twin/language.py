"""Reading a page of the twin language: TOML in, a checked :class:`Definition` out, or every fault with its line."""

import math
import re
from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from otolith.errors import ConfigurationError
from otolith.twin.checks import check_equations
from otolith.twin.definition import Constant, Definition, Input, Output, Parameter, Role, Site, State
from otolith.twin.expressions import check_name
from otolith_drivers.quantities import Quantity, to_base
from otolith_drivers.toml_files import Closed, Location, Page, expect, validate
from otolith_drivers.toml_files import parse as parse_toml

MOST_STATES, MOST_PARAMETERS, MOST_SIGNALS, MOST_DEFINITIONS = 12, 40, 40, 60


def _unit(written: str) -> str:
    if to_base(written)[1] != 0.0:
        raise ValueError(f"{written!r} has a zero of its own, which equations cannot add up: write kelvin")
    return written


def _twin_name(written: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_\-]{0,63}", written):
        raise ValueError(f"{written!r} is no name: a letter, then letters, digits, '_' and '-', at most 64")
    return written


def _no_flag(written: object) -> object:
    if isinstance(written, bool):
        raise ValueError(f"{written!r} is not a number")  # noqa: TRY004 - a fault of a file, not a bug
    return written


Unit = Annotated[str, AfterValidator(_unit)]
Number = Annotated[float | str, BeforeValidator(_no_flag)]
Bounds = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)]


class _Head(Closed):
    name: Annotated[str, AfterValidator(_twin_name)]
    title: str
    source: str
    validity: str = ""


class _State(Closed):
    unit: Unit
    meaning: str
    initial: Number = 0.0
    bounds: Bounds = (-1000.0, 1000.0)


class _Input(Closed):
    unit: Unit
    meaning: str
    hold: Literal["zoh", "foh"]
    range: Bounds = (-1.0, 1.0)


class _Output(Closed):
    unit: Unit
    meaning: str
    noise: Number


class _Parameter(Closed):
    unit: Unit
    nominal: Number
    bounds: Bounds
    meaning: str
    role: Role = Role.INSTRUMENTED


class _Constant(Closed):
    unit: Unit
    value: Number
    meaning: str


class _Definition(Closed):
    expression: str
    meaning: str = ""


class _Site(Closed):
    unit: Unit
    meaning: str
    into: str
    mode: Literal["additive", "multiplicative"]
    through: str = "1"


class _File(Closed):
    twin: _Head
    states: dict[str, _State]
    inputs: Annotated[dict[str, _Input], Field(default_factory=dict)]
    outputs: dict[str, _Output]
    parameters: dict[str, _Parameter]
    constants: Annotated[dict[str, _Constant], Field(default_factory=dict)]
    definitions: Annotated[dict[str, str | _Definition], Field(default_factory=dict)]
    equations: dict[str, str]
    sites: Annotated[dict[str, _Site], Field(default_factory=dict)]


def read_twin(page: Page) -> Definition:
    """The twin on ``page``.

    Raises:
        ConfigurationError: one line per fault, each with file, line, key and the way out.
    """
    data = parse_toml(page)
    expect(page, data, "equations")
    file = validate(data, _File, page)
    reader = _Reader(page, file)
    definition = reader.definition()
    if reader.faults:
        raise ConfigurationError("\n".join(dict.fromkeys(reader.faults)))
    return definition


class _Reader:
    """Collects faults, so that an author sees all of them at once."""

    def __init__(self, page: Page, file: _File) -> None:
        self.faults: list[str] = []
        self._page = page
        self._file = file

    def definition(self) -> Definition:
        file = self._file
        self._check_sizes()
        self._check_names()
        definition = Definition(
            name=file.twin.name,
            title=file.twin.title,
            source=file.twin.source,
            validity=file.twin.validity,
            states=tuple(self._state(name, entry) for name, entry in file.states.items()),
            inputs=tuple(self._input(name, entry) for name, entry in file.inputs.items()),
            outputs=tuple(self._output(name, entry) for name, entry in file.outputs.items()),
            parameters=tuple(self._parameter(name, entry) for name, entry in file.parameters.items()),
            constants=tuple(self._constant(name, entry) for name, entry in file.constants.items()),
            definitions=tuple(
                (name, entry, "") if isinstance(entry, str) else (name, entry.expression, entry.meaning)
                for name, entry in file.definitions.items()
            ),
            equations=tuple(file.equations.items()),
            sites=tuple(Site(name, e.unit, e.meaning, e.into, e.mode, e.through) for name, e in file.sites.items()),
        )
        if not self.faults:
            check_equations(definition, self._fault)
        return definition

    def _fault(self, location: Location, message: str) -> None:
        self.faults.append(f"{self._page.place(location)}: {message}")

    def _check_sizes(self) -> None:
        file = self._file
        for table, entries, most in (
            ("states", file.states, MOST_STATES),
            ("parameters", file.parameters, MOST_PARAMETERS),
            ("inputs", file.inputs, MOST_SIGNALS),
            ("outputs", file.outputs, MOST_SIGNALS),
            ("definitions", file.definitions, MOST_DEFINITIONS),
        ):
            if len(entries) > most:
                self._fault((table,), f"{len(entries)} entries, at most {most} are supported")
        for table, entries in (("states", file.states), ("outputs", file.outputs)):
            if not entries:
                self._fault((table,), f"a twin has at least one entry in [{table}]")

    def _check_names(self) -> None:
        file, owner = self._file, dict[str, str]()
        tables: dict[str, Iterable[str]] = {
            "states": file.states, "inputs": file.inputs, "outputs": file.outputs, "parameters": file.parameters,
            "constants": file.constants, "definitions": file.definitions, "sites": file.sites,
        }  # fmt: skip
        for table, entries in tables.items():
            for name in entries:
                try:
                    check_name(name)
                except ValueError as error:
                    self._fault((table, name), str(error))
                shown_state = {owner.get(name), table} == {"states", "outputs"}
                if name in owner and not shown_state:
                    self._fault((table, name), f"{name!r} is already the name of one of [{owner[name]}]")
                owner.setdefault(name, table)

    def _number(self, location: Location, unit: str, written: Number, *, difference: bool = False) -> float:
        """A number in the declared unit, or a quantity in any unit that fits."""
        try:
            if isinstance(written, int | float):
                return written
            return Quantity(unit, difference=difference).convert(written)
        except ValueError as error:
            self._fault(location, str(error))
            return math.nan

    def _bounds(self, location: Location, unit: str, bounds: Bounds) -> tuple[float, float]:
        low, high = (self._number(location, unit, bound) for bound in bounds)
        if not low < high and not math.isnan(low + high):
            self._fault(location, f"the lower bound {low:g} is not under the upper {high:g} {unit}")
        return low, high

    def _state(self, name: str, entry: _State) -> State:
        low, high = self._bounds(("states", name, "bounds"), entry.unit, entry.bounds)
        initial = self._number(("states", name, "initial"), entry.unit, entry.initial)
        if initial < low < high or initial > high > low:
            self._fault(("states", name), f"initial {initial:g} is outside the bounds {low:g} to {high:g} {entry.unit}")
        return State(name, entry.unit, entry.meaning, initial, low, high)

    def _input(self, name: str, entry: _Input) -> Input:
        low, high = self._bounds(("inputs", name, "range"), entry.unit, entry.range)
        return Input(name, entry.unit, entry.meaning, entry.hold, low, high)

    def _output(self, name: str, entry: _Output) -> Output:
        noise = self._number(("outputs", name, "noise"), entry.unit, entry.noise, difference=True)
        if noise <= 0.0:
            self._fault(("outputs", name), f"noise {noise:g} {entry.unit} must be above zero")
        state = self._file.states.get(name)
        if state is not None and state.unit != entry.unit:
            self._fault(("outputs", name), f"shows the state {name!r}, so its unit must be {state.unit!r} too")
        return Output(name, entry.unit, entry.meaning, noise)

    def _parameter(self, name: str, entry: _Parameter) -> Parameter:
        nominal = self._number(("parameters", name, "nominal"), entry.unit, entry.nominal)
        low, high = self._bounds(("parameters", name, "bounds"), entry.unit, entry.bounds)
        if nominal < low < high or nominal > high > low:
            text = f"nominal {nominal:g} {entry.unit} is outside its bounds {low:g} to {high:g} {entry.unit}"
            self._fault(("parameters", name), text)
        return Parameter(name, entry.unit, nominal, low, high, entry.meaning, entry.role)

    def _constant(self, name: str, entry: _Constant) -> Constant:
        value = self._number(("constants", name, "value"), entry.unit, entry.value)
        return Constant(name, entry.unit, value, entry.meaning)
