"""The variables of an FMU, by their value references: time, states, derivatives, inputs, outputs, values, the rest.

An output has the name of the author. A state is ``state.`` with the name, as the reading of a sensor may differ from
it, and so is ``der(state.…)`` its derivative: the structured names of the FMI standard.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

from otolith.estimation.information import QUANTILE
from otolith.exchange.exported import TIME, ExportedTwin, ExportedValue
from otolith.exchange.identifiers import identifiers
from otolith.twin.definition import Input


class Kind(StrEnum):
    """What a variable is; variables of one kind follow one another, in this order of kinds."""

    TIME = "time"
    STATE = "state"
    RATE = "rate"
    INPUT = "input"
    OUTPUT = "output"
    PARAMETER = "parameter"
    CONSTANT = "constant"
    COMPUTED = "computed"  # A component, or a definition of the author
    INDICATOR = "indicator"  # Changes its sign where the equations change


STARTS = frozenset({Kind.STATE, Kind.INPUT, Kind.PARAMETER, Kind.CONSTANT})  # Others are computed
UNKNOWN_UNIT = ""


@dataclass(frozen=True, slots=True)
class FmuVariable:
    """A variable of an FMU."""

    kind: Kind
    own: str  # Name in the equations; empty of an indicator
    name: str  # In the FMU
    unit: str  # As written in the twin; empty if it is not stated
    meaning: str
    start: float = 0.0
    nominal: float = 1.0
    is_held: bool = False  # An input that is constant between two samples
    tree: ast.expr | None = None  # What it is computed from


@dataclass(frozen=True)
class FmuVariables:
    """All variables of an FMU; the index of each is its value reference."""

    rows: tuple[FmuVariable, ...]

    @classmethod
    def of(cls, twin: ExportedTwin) -> "FmuVariables":
        """Return the variables of a twin."""
        order = list(Kind)
        return cls(tuple(sorted(_rows(twin), key=lambda row: order.index(row.kind))))

    @cached_property
    def first(self) -> dict[Kind, int]:
        """The value reference of the first variable of each kind."""
        found, reference = {}, 0
        for kind in Kind:
            found[kind] = reference
            reference += self.count(kind)
        return found

    def dependencies(self, row: FmuVariable) -> list[int]:
        """Return the value references of time, states and inputs that a computed variable depends on."""
        trees = {other.own: other.tree for other in self.of_kind(Kind.COMPUTED)}
        pending, seen = [row.tree], set[str]()
        while pending:
            tree = pending.pop()
            names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)} if tree is not None else set()
            pending += [trees[name] for name in names - seen if name in trees]
            seen |= names
        kinds = (Kind.TIME, Kind.STATE, Kind.INPUT)
        return [at for at, other in enumerate(self.rows) if other.kind in kinds and other.own in seen]

    def count(self, kind: Kind) -> int:
        """Return the number of variables of a kind."""
        return len(self.of_kind(kind))

    def of_kind(self, kind: Kind) -> list[FmuVariable]:
        """Return the variables of a kind, by their value references."""
        return [row for row in self.rows if row.kind is kind]


def _rows(twin: ExportedTwin) -> Iterator[FmuVariable]:
    quantities = [item.name for group in (twin.inputs, twin.values) for item in group]
    named = [own for group in (twin.outputs, twin.components, twin.definitions) for own, _, _ in group]
    time, before, indicator = identifiers(["time", "state", "indicator"], str, {*quantities, *named}).values()
    yield FmuVariable(Kind.TIME, TIME, time, "s", "time")
    for state, tree in zip(twin.states, twin.rates, strict=True):
        name, meaning = f"{before}.{state.name}", state.meaning
        yield FmuVariable(Kind.STATE, state.name, name, state.unit, meaning, state.initial, state.size)
        unit = "1/s" if state.unit == "1" else f"{state.unit}/s"
        yield FmuVariable(Kind.RATE, f"d {state.name}/dt", f"der({name})", unit, f"change of: {meaning}", tree=tree)
    for item in twin.inputs:
        held = item.hold == "zoh"
        yield FmuVariable(Kind.INPUT, item.name, item.name, item.unit, item.meaning, _ordinary(item), is_held=held)
    for (own, unit, meaning), tree in zip(twin.outputs, twin.shown, strict=True):
        yield FmuVariable(Kind.OUTPUT, own, own, unit, meaning, tree=tree)
    for value in twin.values:
        kind = Kind.CONSTANT if value.is_constant else Kind.PARAMETER
        yield FmuVariable(kind, value.name, value.name, value.unit, _known(value), value.value)
    for own, tree, words in twin.components:
        yield FmuVariable(Kind.COMPUTED, own, own, UNKNOWN_UNIT, f"discovered component, {words}", tree=tree)
    for own, tree, meaning in twin.definitions:
        yield FmuVariable(Kind.COMPUTED, own, own, UNKNOWN_UNIT, f"{meaning}, in SI units", tree=tree)
    for number, tree in enumerate(_switches(twin), start=1):
        yield FmuVariable(
            Kind.INDICATOR, "", f"{indicator}.switch_{number}", UNKNOWN_UNIT, "changes its sign at an event", tree=tree
        )


def _ordinary(item: Input) -> float:
    """Return a value that an input may have: zero where that is within its range."""
    return min(max(0.0, item.low), item.high) if item.has_range else 0.0


def _known(value: ExportedValue) -> str:
    unit = "" if value.unit == "1" else f" {value.unit}"
    known = f"estimated, ± {QUANTILE * value.sd:.3g}{unit} (95 %)" if value.sd else "given"
    return f"{value.meaning}; {known}"


def _switches(twin: ExportedTwin) -> list[ast.expr]:
    """Return what changes its sign where the equations, or their slopes, change at once."""
    named = [tree for group in (twin.components, twin.definitions) for _, tree, _ in group]
    fixed = {value.name for value in twin.values}
    found: dict[str, ast.expr] = {}
    for tree in (*named, *twin.rates, *twin.shown):
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=ast.Name(id="sign" | "abs"), args=[argument]):
                    side = argument
                case ast.Call(func=ast.Name(id="min" | "max"), args=[left, right]):
                    side = ast.BinOp(left, ast.Sub(), right)
                case ast.Compare(left=left, comparators=[right]):
                    side = ast.BinOp(left, ast.Sub(), right)
                case _:
                    continue
            names = {part.id for part in ast.walk(side) if isinstance(part, ast.Name)}
            if names - fixed:
                found.setdefault(ast.dump(side), side)
    return list(found.values())
