"""The twin language: a TOML file in, a checked :class:`Definition` out, or every fault with its line.

First the schema of the file, then its quantities and names, then its equations: known symbols, no algebraic loops, the
same dimension on both sides.
"""

import ast
import math
import re
from collections.abc import Callable, Mapping, Sized
from contextlib import suppress
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from otolith.twin.definition import (
    Constant,
    Definition,
    Figure,
    Input,
    OperatingRange,
    Output,
    Parameter,
    Role,
    Site,
    StateVariable,
)
from otolith.twin.expressions import (
    Dimension,
    ExpressionError,
    check_known,
    check_name,
    describe,
    dimension_of,
    dimensionless,
    infer_dimension,
    names_in,
    parse,
    row_of_fmu,
)
from otolith_drivers.config_files import Limits, Location, SourceFile, StrictModel, dotted, expect, validate
from otolith_drivers.config_files import parse as parse_toml
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.units import Quantity, factor, limit_values, to_base

# Limits keep the compile time of a kernel in minutes; docs/reference/thresholds-twin.md.
MAX_COEFFICIENT = -0.1, 0.1  # 1/K: lowest and highest temperature coefficient
MAX_ROWS = {"states": 12, "parameters": 40, "inputs": 40, "outputs": 40, "definitions": 60, "performance": 12}
MAX_EXPANDED_TERMS, MAX_EXPANDED_LEVELS = 3000, 100  # of an equation with its definitions substituted

Fault = Callable[[Location, str], None]  # Records what is wrong at a place of the file


def _unit(written: str) -> str:
    if to_base(written)[1] != 0.0:
        raise ValueError(f"{written!r} has an offset, so equations cannot use it: write 'K'")
    return written


def _twin_name(written: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_\-]{0,63}", written):
        raise ValueError(f"{written!r} is not a name: write a letter, then letters, digits, '_' and '-', at most 64")
    return written


def _no_boolean(written: object) -> object:
    if isinstance(written, bool):
        raise ValueError(f"{written!r} is not a number")  # noqa: TRY004 - a fault of a file, not a bug
    return written


Unit = Annotated[str, AfterValidator(_unit)]
Number = Annotated[float | str, BeforeValidator(_no_boolean)]
Bounds = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)]


class _HeadTable(StrictModel):
    name: Annotated[str, AfterValidator(_twin_name)]
    title: str
    source: str
    validity: str = ""


class _QuantityTable(StrictModel):
    unit: Unit
    meaning: str


class _StateTable(_QuantityTable):
    initial: Number = 0.0
    bounds: Bounds = (-1000.0, 1000.0)


class _InputTable(_QuantityTable):
    hold: Literal["zoh", "foh"]
    range: Bounds = (-1.0, 1.0)


class _OutputTable(_QuantityTable):
    noise: Number


class _ParameterTable(_QuantityTable):
    nominal: Number
    bounds: Bounds
    role: Role = Role.INSTRUMENTED
    part: str = ""
    watch: Limits = ()
    act: Limits = ()
    temperature_coefficient: Annotated[float, BeforeValidator(Quantity("1/K", *MAX_COEFFICIENT))] = 0.0


class _ConstantTable(_QuantityTable):
    value: Number


class _DefinitionTable(StrictModel):
    expression: str
    meaning: str = ""


class _SiteTable(_QuantityTable):
    into: str
    mode: Literal["additive", "multiplicative"]
    through: str = "1"
    part: str = ""


class FigureTable(_QuantityTable):
    """A figure of performance."""

    expression: str
    better: Literal["lower", "higher"]
    at: Annotated[dict[str, Number], Field(default_factory=dict)]
    required: Number | None = None


class OwnFigureTable(StrictModel):
    """A figure of performance in a machine file; what it does not state is that of the figure of the twin."""

    unit: Unit | None = None
    meaning: str | None = None
    expression: str | None = None
    better: Literal["lower", "higher"] | None = None
    at: dict[str, Number] | None = None
    required: Number | None = None


class OperationTable(StrictModel):
    """Where the equations hold, by a signal, in a twin or in a machine file."""

    above: Number | None = None
    below: Number | None = None


class _TwinFile(StrictModel):
    twin: _HeadTable
    states: dict[str, _StateTable]
    inputs: Annotated[dict[str, _InputTable], Field(default_factory=dict)]
    outputs: dict[str, _OutputTable]
    parameters: dict[str, _ParameterTable]
    constants: Annotated[dict[str, _ConstantTable], Field(default_factory=dict)]
    definitions: Annotated[dict[str, str | _DefinitionTable], Field(default_factory=dict)]
    equations: dict[str, str]
    sites: Annotated[dict[str, _SiteTable], Field(default_factory=dict)]
    performance: Annotated[dict[str, FigureTable], Field(default_factory=dict)]
    operation: Annotated[dict[str, OperationTable], Field(default_factory=dict)]


def read_twin(page: SourceFile) -> Definition:
    """The twin in the file ``page``; raise ConfigurationError with file, line, key and remedy of each fault."""
    data = parse_toml(page)
    expect(page, data, "equations")
    faults: list[str] = []

    def fault(location: Location, message: str) -> None:
        faults.append(f"{page.place(location)}: {message}")

    file = validate(data, _TwinFile, page)
    definition = with_operation(_Reader(file, fault).definition(), file.operation, fault)
    if not faults:
        checker = _EquationChecker(definition, fault)
        checker.check()
        if not faults:
            checker.check_performance()
    if faults:
        raise ConfigurationError("\n".join(dict.fromkeys(faults)))
    return definition


def with_performance(definition: Definition, tables: Mapping[str, OwnFigureTable], fault: Fault) -> Definition:
    """Return the twin with other figures of performance, and with other keys of its own; reports each fault."""
    own = {figure.name: figure for figure in definition.performance}
    for name, table in tables.items():
        try:
            check_name(name)
        except ValueError as error:
            fault(("performance", name), str(error))
        written = table.model_dump(exclude_none=True)
        if (known := own.get(name)) is not None:
            written = _inherited(known, written, fault) | written
        missing = [key for key, row in FigureTable.model_fields.items() if row.is_required() and key not in written]
        if missing:
            text = f"the twin has no figure {name!r}, so {missing[0]} is needed here: {nearest(name, list(own))}"
            fault(("performance", name), text)
            continue
        own[name] = _figure(name, FigureTable(**written), definition.units(), fault)
    complete = replace(definition, performance=tuple(own.values()))
    checker = _EquationChecker(complete, fault)
    checker.check()
    checker.check_performance()
    return complete


def _inherited(known: Figure, written: Mapping[str, Any], fault: Fault) -> dict[str, Any]:
    """Return the keys of a figure of the twin; what it requires is in the unit that is written for it now."""
    keys = {key: getattr(known, key) for key in FigureTable.model_fields} | {"at": dict(known.at)}
    if known.required is not None and "required" not in written and (unit := written.get("unit")) is not None:
        try:
            keys["required"] = factor(known.unit, unit)[0] * known.required
        except ValueError as error:
            stated = f"the twin requires {known.required:g} {known.unit}"
            fault(("performance", known.name, "unit"), f"{error}: {stated}: write 'required' in {unit} here")
    return keys


def with_operation(definition: Definition, tables: Mapping[str, OperationTable], fault: Fault) -> Definition:
    """Return the twin with other ranges of its signals in which the equations hold; reports each fault."""
    ranges, units = {item.signal: item for item in definition.operation}, definition.units()
    for name, table in tables.items():
        at: Location = ("operation", name)
        if name not in definition.signals:
            fault(at, f"the twin has no signal {name!r}: {nearest(name, list(definition.signals))}")
            continue
        try:
            low = -math.inf if table.above is None else _in_unit(table.above, units[name])
            high = math.inf if table.below is None else _in_unit(table.below, units[name])
        except ValueError as error:
            fault(at, str(error))
            continue
        if not low < high or (low, high) == (-math.inf, math.inf):
            fault(at, f"the equations hold above {low:g} and below {high:g} {units[name]}: state one, or a range")
        ranges[name] = OperatingRange(name, low, high)
    return replace(definition, operation=tuple(ranges.values()))


def _in_unit(written: Number, unit: str, *, difference: bool = False) -> float:
    return Quantity(unit, difference=difference).convert(written) if isinstance(written, str) else float(written)


def _figure(name: str, table: FigureTable, units: Mapping[str, str], fault: Fault) -> Figure:
    """Return a figure with its numbers in the units of the twin; a name that is none is reported later."""

    def number(written: Number, unit: str | None, *at: str) -> float:
        try:
            return math.nan if unit is None else _in_unit(written, unit)
        except ValueError as error:
            fault(("performance", name, *at), str(error))
            return math.nan

    point = tuple((signal, number(written, units.get(signal), "at", signal)) for signal, written in table.at.items())
    required = None if table.required is None else number(table.required, table.unit, "required")
    return Figure(name, table.unit, table.meaning, table.expression, table.better, point, required)


def equation_faults(definition: Definition) -> list[str]:
    """Return what is wrong with the equations of a twin that was made from another one, one text each."""
    faults: list[str] = []
    _EquationChecker(definition, lambda at, text: faults.append(f"{dotted(at)}: {text}")).check()
    return faults


class _Reader:
    """Converts quantities to their declared units; collects faults, so that an author sees all of them at once."""

    def __init__(self, file: _TwinFile, fault: Fault) -> None:
        self._file = file
        self._fault = fault

    def definition(self) -> Definition:
        file = self._file
        self._check_sizes()
        self._check_names()
        return Definition(
            name=file.twin.name,
            title=file.twin.title,
            source=file.twin.source,
            validity=file.twin.validity,
            states=tuple(self._state(name, table) for name, table in file.states.items()),
            inputs=tuple(self._input(name, table) for name, table in file.inputs.items()),
            outputs=tuple(self._output(name, table) for name, table in file.outputs.items()),
            parameters=tuple(self._parameter(name, table) for name, table in file.parameters.items()),
            constants=tuple(self._constant(name, table) for name, table in file.constants.items()),
            definitions=tuple(
                (name, table, "") if isinstance(table, str) else (name, table.expression, table.meaning)
                for name, table in file.definitions.items()
            ),
            equations=tuple(file.equations.items()),
            sites=tuple(
                Site(name, t.unit, t.meaning, t.into, t.mode, t.through, t.part or name)
                for name, t in file.sites.items()
            ),
            performance=tuple(
                _figure(name, table, self._units(), self._fault) for name, table in file.performance.items()
            ),
        )

    def _units(self) -> dict[str, str]:
        return {name: row.unit for group in (self._file.states, self._file.inputs) for name, row in group.items()}

    def _check_sizes(self) -> None:
        for table, limit in MAX_ROWS.items():
            rows: Sized = getattr(self._file, table)
            if len(rows) > limit:
                self._fault((table,), f"has {len(rows)} rows: at most {limit} are supported")
            if not rows and table in ("states", "outputs"):
                self._fault((table,), f"a twin needs at least one row in [{table}]")

    def _check_names(self) -> None:
        owner: dict[str, str] = {}
        for table in ("states", "inputs", "outputs", "parameters", "constants", "definitions", "sites",
                      "performance"):  # fmt: skip
            for name in getattr(self._file, table):
                try:
                    check_name(name)
                except ValueError as error:
                    self._fault((table, name), str(error))
                shown_state = {owner.get(name), table} == {"states", "outputs"}
                if name in owner and not shown_state:
                    self._fault((table, name), f"{name!r} is already the name of one of [{owner[name]}]")
                owner.setdefault(name, table)

    def _number(self, location: Location, unit: str, written: Number, *, difference: bool = False) -> float:
        """A number in the declared unit, or a quantity in any unit of the same dimension; NaN after a fault."""
        try:
            return _in_unit(written, unit, difference=difference)
        except ValueError as error:
            self._fault(location, str(error))
            return math.nan

    def _bounds(self, location: Location, unit: str, bounds: Bounds) -> tuple[float, float]:
        low, high = (self._number(location, unit, bound) for bound in bounds)
        if not low < high and not math.isnan(low + high):
            self._fault(location, f"the lower bound {low:g} {unit} must be below the upper bound {high:g} {unit}")
        return low, high

    def _inside(self, location: Location, unit: str, key: str, written: Number, bounds: tuple[float, float]) -> float:
        """A number that must be within valid ``bounds``."""
        value, (low, high) = self._number((*location, key), unit, written), bounds
        if value < low < high or value > high > low:
            self._fault(location, f"{key} {value:g} {unit} is outside its bounds {low:g} to {high:g} {unit}")
        return value

    def _state(self, name: str, table: _StateTable) -> StateVariable:
        bounds = self._bounds(("states", name, "bounds"), table.unit, table.bounds)
        initial = self._inside(("states", name), table.unit, "initial", table.initial, bounds)
        return StateVariable(name, table.unit, table.meaning, initial, *bounds)

    def _input(self, name: str, table: _InputTable) -> Input:
        bounds = self._bounds(("inputs", name, "range"), table.unit, table.range)
        return Input(name, table.unit, table.meaning, table.hold, *bounds, has_range="range" in table.model_fields_set)

    def _output(self, name: str, table: _OutputTable) -> Output:
        noise = self._number(("outputs", name, "noise"), table.unit, table.noise, difference=True)
        if noise <= 0.0:
            self._fault(("outputs", name), f"noise {noise:g} {table.unit} must be above zero")
        state = self._file.states.get(name)
        if state is not None and state.unit != table.unit:
            self._fault(("outputs", name), f"shows the state {name!r}: its unit must be {state.unit!r} too")
        return Output(name, table.unit, table.meaning, noise)

    def _parameter(self, name: str, table: _ParameterTable) -> Parameter:
        bounds = self._bounds(("parameters", name, "bounds"), table.unit, table.bounds)
        nominal = self._inside(("parameters", name), table.unit, "nominal", table.nominal, bounds)
        for key, limits in (("watch", table.watch), ("act", table.act)):
            try:
                limit_values(limits, table.unit, nominal)
            except ValueError as error:
                self._fault(("parameters", name, key), str(error))
        parameter = Parameter(name, table.unit, nominal, *bounds, table.meaning, table.role, table.part)
        coefficient = table.temperature_coefficient
        return replace(parameter, watch=table.watch, act=table.act, temperature_coefficient=coefficient)

    def _constant(self, name: str, table: _ConstantTable) -> Constant:
        value = self._number(("constants", name, "value"), table.unit, table.value)
        return Constant(name, table.unit, value, table.meaning)


class _EquationChecker:
    """Checks the equations of a definition whose quantities are right."""

    def __init__(self, definition: Definition, fault: Fault) -> None:
        self._definition = definition
        self._report = fault
        self._faulty = False
        self._states = [state.name for state in definition.states]
        self._outputs = [output.name for output in definition.outputs if output.name not in self._states]
        self._units = {name: dimension_of(unit) for name, unit in definition.units().items()}
        self._known: dict[str, Dimension] = {n: d for n, d in self._units.items() if n not in self._outputs}
        """Dimension of every name that an expression may use: outputs follow from the states and are not among them."""
        self._trees: dict[str, ast.expr] = {}  # Of the definitions

    def check(self) -> None:
        """Report the faults of a stage only if the stages before have none, because they would follow from those."""
        self._check_definitions()
        self._check_left_sides()
        used: set[str] = set()
        for left, text in self._definition.equations:
            tree = self._tree(("equations", left), text)
            if tree is not None and not self._faulty:
                used |= names_in(tree)
                self._check_dimensions(left, tree)
                self._check_expanded_size(left, tree)
        if not self._faulty:
            self._check_used(used)
            for site in self._definition.sites:
                self._check_site(site)

    def check_performance(self) -> None:
        """Report the faults of the figures of performance; :meth:`check` comes first."""
        shown = {output.name for output in self._definition.outputs}
        hidden = [name for name in self._states if name not in shown]
        driving = [*self._states, *(driven.name for driven in self._definition.inputs)]
        for figure in self._definition.performance:
            at: Location = ("performance", figure.name)
            for name, _ in figure.at:
                if name not in driving:
                    self._fault(
                        (*at, "at", name), f"{name!r} is neither an input nor a state: {nearest(name, driving)}"
                    )
            if (tree := self._tree((*at, "expression"), figure.expression)) is None:
                continue
            for name in sorted(self._used_by(names_in(tree)) & set(hidden) - {name for name, _ in figure.at}):
                text = (
                    f"no output shows the state {name!r}, so a window has no value of it: write at = {{ {name} = ... }}"
                )
                self._fault((*at, "expression"), text)
            inferred = self._dimension((*at, "expression"), tree)
            if inferred is not None and inferred != dimension_of(figure.unit):
                text = f"the unit {figure.unit!r} is in {describe(dimension_of(figure.unit))}, the expression in"
                self._fault((*at, "expression"), f"{text} {describe(inferred)}")

    def _used_by(self, names: set[str]) -> set[str]:
        """Return ``names``, and those that the definitions among them use, directly or through others."""
        used, pending = set(names), list(names)
        while pending:
            inner = names_in(self._trees[name]) if (name := pending.pop()) in self._trees else set()
            pending += inner - used
            used |= inner
        return used

    def _fault(self, location: Location, message: str) -> None:
        self._faulty = True
        self._report(location, message)

    def _tree(self, location: Location, text: str, pending: Mapping[str, Any] | None = None) -> ast.expr | None:
        """The tree of an expression that uses known names and ``pending`` ones only; None after a fault."""
        known = self._known.keys() | (pending or {}).keys()
        try:
            tree = parse(text)
            for name in sorted(names_in(tree) & (set(self._outputs) - known)):
                self._fault(location, f"{name!r} is an output, which no expression may use: move it to a definition")
                return None
            check_known(tree, known)
        except ExpressionError as error:
            self._fault(location, str(error))
            return None
        return tree

    def _dimension(self, location: Location, tree: ast.expr) -> Dimension:
        """The dimension of an expression; None after a fault, as for the number zero."""
        try:
            return infer_dimension(tree, self._known)
        except ExpressionError as error:
            self._fault(location, str(error))
            return None

    def _left_dimension(self, left: str) -> Dimension:
        """The dimension that the left side of an equation or definition has; None if it is unknown."""
        if left.startswith("der(") and left[4:-1] in self._units:
            return self._units[left[4:-1]] / dimension_of("s")
        return self._units.get(left, self._known.get(left))

    def _check_definitions(self) -> None:
        """Parse definitions and infer their dimensions, those first that the others use."""
        helpers = {name: text for name, text, _ in self._definition.definitions}
        trees = {name: self._tree(("definitions", name), text, helpers) for name, text in helpers.items()}
        self._trees = {name: tree for name, tree in trees.items() if tree is not None}
        pending = dict(self._trees)
        while pending:
            ready = [name for name, tree in pending.items() if not names_in(tree) & pending.keys()]
            if not ready:
                first = next(iter(pending))
                loop = " -> ".join([*pending, first])
                text = f"an algebraic loop: {loop}: solve it by hand, or make one of them a state"
                self._fault(("definitions", first), text)
                self._known.update(dict.fromkeys(pending))
                break
            for name in ready:
                self._known[name] = self._dimension(("definitions", name), pending.pop(name))

    def _check_left_sides(self) -> None:
        wanted = [*(f"der({name})" for name in self._states), *self._outputs]
        written = [left for left, _ in self._definition.equations]
        for left in written:
            if left in self._states:
                self._fault(("equations", left), f"{left!r} is a state: write its derivative, der({left})")
            elif left not in wanted:
                self._fault(("equations", left), f"no state or output has this equation: {nearest(left, wanted)}")
        for left in wanted:
            if left not in written:
                self._fault(("equations",), f"the equation of {left} is missing")

    def _check_dimensions(self, left: str, tree: ast.expr) -> None:
        if self._definition.fmu is not None and row_of_fmu(tree) is not None:
            return  # the FMU states its units, which were compared when the twin was made of it
        expected, inferred = self._left_dimension(left), self._dimension(("equations", left), tree)
        if expected is not None and inferred is not None and inferred != expected:
            text = f"the left side is in {describe(expected)}, the right side in {describe(inferred)}"
            self._fault(("equations", left), text)

    def _check_expanded_size(self, left: str, tree: ast.expr) -> None:
        """Definitions are substituted where they are used, so their sizes multiply."""
        terms, levels = self._expanded_size(tree, {})
        if terms > MAX_EXPANDED_TERMS or levels > MAX_EXPANDED_LEVELS:
            self._fault(
                ("equations", left),
                f"with its definitions written out it has {terms} terms, {levels} levels deep, but at most "
                f"{MAX_EXPANDED_TERMS} and {MAX_EXPANDED_LEVELS} are supported: simplify, or make one of them a state",
            )

    def _expanded_size(self, tree: ast.expr, sizes: dict[str, tuple[int, int]]) -> tuple[int, int]:
        """Terms and levels with definitions substituted; ``sizes`` holds those of definitions that are known."""
        terms, levels = 0, 0
        pending: list[tuple[ast.AST, int]] = [(tree, 1)]
        while pending:
            node, level = pending.pop()
            inner = (1, 0)
            if isinstance(node, ast.Name) and node.id in self._trees:
                if node.id not in sizes:
                    sizes[node.id] = self._expanded_size(self._trees[node.id], sizes)
                inner = sizes[node.id]
            terms += inner[0]
            levels = max(levels, level + inner[1])
            pending += [(child, level + 1) for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]
        return terms, levels

    def _check_used(self, used: set[str]) -> None:
        """Every quantity must act on an equation, directly or through definitions, or be used by a site."""
        for site in self._definition.sites:
            try:
                used |= names_in(parse(site.through))
            except ExpressionError:
                continue  # the check of the site reports it
        used, of_figures = self._used_by(used), set[str]()
        for figure in self._definition.performance:
            with suppress(ExpressionError):  # check_performance reports it
                of_figures |= self._used_by(names_in(parse(figure.expression)))
        fixed = {"constants": [fixed.name for fixed in self._definition.constants]}
        fixed |= {"definitions": [name for name, _, _ in self._definition.definitions]}
        tables = {
            "parameters": [parameter.name for parameter in self._definition.parameters],
            "inputs": [driven.name for driven in self._definition.inputs],
            **{table: [name for name in rows if name not in of_figures] for table, rows in fixed.items()},
        }
        for table, rows in tables.items():
            for name in rows:
                if name not in used:
                    self._fault((table, name), "appears in no equation: use it or leave it out")

    def _check_site(self, site: Site) -> None:
        at: Location = ("sites", site.name)
        targets = [left for left, _ in self._definition.equations]
        targets += [name for name, _, _ in self._definition.definitions]
        if site.into not in targets:
            text = f"into {site.into!r}, which is neither an equation nor a definition: {nearest(site.into, targets)}"
            self._fault(at, text)
            return
        if site.mode == "multiplicative":
            if site.through != "1" or dimension_of(site.unit) != dimensionless():
                self._fault(at, 'a multiplicative component has no unit: write unit = "1", and no through')
            return
        tree = self._tree(at, site.through)
        if tree is None:
            return
        try:
            entering = (infer_dimension(tree, self._known) or dimensionless()) * dimension_of(site.unit)
        except ExpressionError as error:
            self._fault(at, str(error))
            return
        expected = self._left_dimension(site.into)
        if expected is not None and entering != expected:
            text = f"through * component is in {describe(entering)}, but {site.into} is in {describe(expected)}"
            self._fault(at, text)
