"""Reading a page of the twin language: TOML in, a checked :class:`Definition` out, or every fault with its line.

Whether the equations of a page can be meant: known symbols, no loops, the same dimension on both sides.
"""

import ast
import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from otolith.twin.definition import Constant, Definition, Input, Output, Parameter, Role, Site, StateVariable
from otolith.twin.dimensions import NONE, describe, dimension_of, measure
from otolith.twin.expressions import ExpressionError, check_known, check_name, names, parse
from otolith_drivers.config_files import Location, SourceFile, StrictModel, expect, validate
from otolith_drivers.config_files import parse as parse_toml
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.units import Quantity, to_base

MOST_TERMS, MOST_LEVELS = 3000, 100  # of an expression with its definitions written out

Fault = Callable[[Location, str], None]


def check_equations(definition: Definition, fault: Fault) -> None:
    """Tell ``fault`` everything that is wrong with the equations of ``definition``, and where."""
    _Checker(definition, fault).check()


class _Checker:
    def __init__(self, definition: Definition, fault: Fault) -> None:
        self._definition = definition
        self._tell = fault
        self._faulty = False
        self._states = [entry.name for entry in definition.states]

    def _fault(self, location: Location, message: str) -> None:
        self._faulty = True
        self._tell(location, message)

    def check(self) -> None:
        """In stages, as a fault in one makes nonsense of what the next would say."""
        known = {name: dimension_of(unit) for name, unit in self._definition.units().items()}
        for output in self._definition.outputs:
            if output.name not in self._states:
                del known[output.name]
        trees = self._definitions(known)
        self._check_left_sides()
        used: set[str] = set()
        for left, text in self._definition.equations:
            tree = self._tree(("equations", left), text, known)
            if tree is not None and not self._faulty:
                used |= names(tree)
                self._check_sides(("equations", left), tree, known, _left_dimension(left, self._definition))
                self._check_size(("equations", left), tree, trees)
        for site in self._definition.sites:
            used |= _names_in(site.through)
        if not self._faulty:
            self._check_used(_reachable(used, trees))
            for site in self._definition.sites:
                self._check_site(site, known)

    def _tree(self, location: Location, text: str, known: Mapping[str, Any]) -> ast.expr | None:
        outputs = {entry.name for entry in self._definition.outputs} - set(self._states)
        try:
            tree = parse(text)
            for name in sorted(names(tree) & outputs - set(known)):
                self._fault(location, f"{name!r} is an output and follows from the states: use a definition for both")
                return None
            check_known(tree, known)
        except ExpressionError as error:
            self._fault(location, str(error))
            return None
        return tree

    def _check_sides(self, location: Location, tree: ast.expr, known: Mapping[str, Any], left: Any) -> None:
        try:
            found = measure(tree, known)
        except ExpressionError as error:
            self._fault(location, str(error))
            return
        if left is not None and found is not None and found != left:
            self._fault(location, f"the left side is in {describe(left)}, the right side in {describe(found)}")

    def _definitions(self, known: dict[str, Any]) -> dict[str, ast.expr]:
        """Parse helper quantities in the order of their use; adds what each measures to ``known``."""
        helpers = [name for name, _, _ in self._definition.definitions]
        everything = {**known, **dict.fromkeys(helpers)}
        pending = {}
        for name, text, _ in self._definition.definitions:
            tree = self._tree(("definitions", name), text, everything)
            if tree is not None:
                pending[name] = tree
        trees = dict(pending)
        while pending:
            ready = [name for name, tree in pending.items() if not names(tree) & set(pending)]
            if not ready:
                loop = " -> ".join([*pending, next(iter(pending))])
                self._fault(("definitions", next(iter(pending))), f"an algebraic loop: {loop}; solve it by hand first")
                known.update(dict.fromkeys(pending))
                break
            for name in ready:
                try:
                    known[name] = measure(pending[name], known)
                except ExpressionError as error:
                    self._fault(("definitions", name), str(error))
                    known[name] = None
                del pending[name]
        return trees

    def _check_left_sides(self) -> None:
        wanted = [f"der({name})" for name in self._states]
        wanted += [entry.name for entry in self._definition.outputs if entry.name not in self._states]
        written = [left for left, _ in self._definition.equations]
        for left in written:
            if left in self._states:
                self._fault(("equations", left), f"{left!r} is a state: write its derivative, der({left})")
            elif left not in wanted:
                self._fault(("equations", left), f"no state or output has this equation: {nearest(left, wanted)}")
        for left in wanted:
            if left not in written:
                self._fault(("equations",), f"the equation of {left} is missing")

    def _check_used(self, used: set[str]) -> None:
        tables: dict[str, list[str]] = {
            "parameters": [entry.name for entry in self._definition.parameters],
            "inputs": [entry.name for entry in self._definition.inputs],
            "constants": [entry.name for entry in self._definition.constants],
            "definitions": [name for name, _, _ in self._definition.definitions],
        }
        for table, entries in tables.items():
            for name in entries:
                if name not in used:
                    self._fault((table, name), "appears in no equation: use it or leave it out")

    def _check_size(self, location: Location, tree: ast.expr, trees: Mapping[str, ast.expr]) -> None:
        """Definitions are written out in what uses them, so their sizes multiply."""
        terms, depth = _written_out(tree, trees, {})
        if terms > MOST_TERMS or depth > MOST_LEVELS:
            self._fault(
                location,
                f"with its definitions written out it has {terms} terms, {depth} levels deep: "
                f"at most {MOST_TERMS} and {MOST_LEVELS} are supported, so make one of them a state or simplify",
            )

    def _check_site(self, site: Site, known: Mapping[str, Any]) -> None:
        at: Location = ("sites", site.name)
        places = [left for left, _ in self._definition.equations] + [
            name for name, _, _ in self._definition.definitions
        ]
        if site.into not in places:
            self._fault(at, f"into {site.into!r}, which is no left side or definition: {nearest(site.into, places)}")
            return
        if site.mode == "multiplicative":
            if site.through != "1" or dimension_of(site.unit) != NONE:
                self._fault(at, 'a multiplicative component is a plain number: unit = "1", and no through')
            return
        tree = self._tree(at, site.through, known)
        if tree is None:
            return
        left = known.get(site.into) if site.into in known else _left_dimension(site.into, self._definition)
        try:
            entering = (measure(tree, known) or NONE) * dimension_of(site.unit)
        except ExpressionError as error:
            self._fault(at, str(error))
            return
        if left is not None and entering != left:
            text = f"through * component is in {describe(entering)}, but {site.into} is in {describe(left)}"
            self._fault(at, text)


def _written_out(tree: ast.expr, trees: Mapping[str, ast.expr], known: dict[str, tuple[int, int]]) -> tuple[int, int]:
    """Terms and levels of an expression with its definitions written out; ``known`` remembers those of definitions."""
    terms, levels = 0, 0
    pending: list[tuple[ast.AST, int]] = [(tree, 1)]
    while pending:
        node, level = pending.pop()
        inner = (1, 0)
        if isinstance(node, ast.Name) and node.id in trees:
            if node.id not in known:
                known[node.id] = _written_out(trees[node.id], trees, known)
            inner = known[node.id]
        terms += inner[0]
        levels = max(levels, level + inner[1])
        pending += [(child, level + 1) for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]
    return terms, levels


def _reachable(used: set[str], trees: Mapping[str, ast.expr]) -> set[str]:
    """``used``, and what the definitions in it use."""
    found, pending = set(used), list(used)
    while pending:
        inner = names(trees[name]) if (name := pending.pop()) in trees else set()
        pending += inner - found
        found |= inner
    return found


def _left_dimension(left: str, definition: Definition) -> Any:
    units = definition.units()
    if left.startswith("der(") and left[4:-1] in units:
        return dimension_of(units[left[4:-1]]) / dimension_of("s")
    return dimension_of(units[left]) if left in units else None


def _names_in(text: str) -> set[str]:
    try:
        return names(parse(text))
    except ExpressionError:
        return set()


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


class _Head(StrictModel):
    name: Annotated[str, AfterValidator(_twin_name)]
    title: str
    source: str
    validity: str = ""


class _StateTable(StrictModel):
    unit: Unit
    meaning: str
    initial: Number = 0.0
    bounds: Bounds = (-1000.0, 1000.0)


class _Input(StrictModel):
    unit: Unit
    meaning: str
    hold: Literal["zoh", "foh"]
    range: Bounds = (-1.0, 1.0)


class _Output(StrictModel):
    unit: Unit
    meaning: str
    noise: Number


class _Parameter(StrictModel):
    unit: Unit
    nominal: Number
    bounds: Bounds
    meaning: str
    role: Role = Role.INSTRUMENTED


class _Constant(StrictModel):
    unit: Unit
    value: Number
    meaning: str


class _Definition(StrictModel):
    expression: str
    meaning: str = ""


class _Site(StrictModel):
    unit: Unit
    meaning: str
    into: str
    mode: Literal["additive", "multiplicative"]
    through: str = "1"


class _TwinFile(StrictModel):
    twin: _Head
    states: dict[str, _StateTable]
    inputs: Annotated[dict[str, _Input], Field(default_factory=dict)]
    outputs: dict[str, _Output]
    parameters: dict[str, _Parameter]
    constants: Annotated[dict[str, _Constant], Field(default_factory=dict)]
    definitions: Annotated[dict[str, str | _Definition], Field(default_factory=dict)]
    equations: dict[str, str]
    sites: Annotated[dict[str, _Site], Field(default_factory=dict)]


def read_twin(page: SourceFile) -> Definition:
    """The twin on ``page``.

    Raises:
        ConfigurationError: one line per fault, each with file, line, key and the way out.
    """
    data = parse_toml(page)
    expect(page, data, "equations")
    file = validate(data, _TwinFile, page)
    reader = _Reader(page, file)
    definition = reader.definition()
    if reader.faults:
        raise ConfigurationError("\n".join(dict.fromkeys(reader.faults)))
    return definition


class _Reader:
    """Collects faults, so that an author sees all of them at once."""

    def __init__(self, page: SourceFile, file: _TwinFile) -> None:
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

    def _state(self, name: str, entry: _StateTable) -> StateVariable:
        low, high = self._bounds(("states", name, "bounds"), entry.unit, entry.bounds)
        initial = self._number(("states", name, "initial"), entry.unit, entry.initial)
        if initial < low < high or initial > high > low:
            self._fault(("states", name), f"initial {initial:g} is outside the bounds {low:g} to {high:g} {entry.unit}")
        return StateVariable(name, entry.unit, entry.meaning, initial, low, high)

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
