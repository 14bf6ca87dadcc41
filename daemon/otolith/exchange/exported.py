"""The adapted twin as equations with discovered components at their sites: what every exported text is written from.

Expressions are syntax trees of the twin language. Equations hold in coherent units, so a quantity in another unit
enters with its factor. Components see measured inputs; what a sensor adds to an input is subtracted before the input
drives the twin.
"""

import ast
import copy
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from otolith.estimation.objective import time_offsets
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, equation, indices, site_of, source_of
from otolith.exchange.identifiers import free_name
from otolith.simulation.initial_state import last_state
from otolith.simulation.what_if import supposed_values
from otolith.twin.components import shift_setting
from otolith.twin.definition import Input, Site
from otolith.twin.expressions import parse
from otolith_drivers.units import to_base

Expressions = Mapping[str, ast.expr]
TIME = "_time"  # s since the first record; no author can write such a name


@dataclass(frozen=True, slots=True)
class ExportedValue:
    """A parameter, a constant or the value of a component."""

    name: str
    value: float
    sd: float  # Standard deviation; 0 of a value that is given
    unit: str
    meaning: str
    is_constant: bool = False  # Of nature or of the design: no machine file changes it


@dataclass(frozen=True, slots=True)
class ExportedState:
    """A state, or the angle that a component depends on."""

    name: str
    unit: str
    meaning: str
    initial: float  # At the last record that was learned from
    size: float  # Largest ordinary magnitude


@dataclass(frozen=True, slots=True)
class ExportedTwin:
    """Equations and values. Names are those of the author; no two are the same."""

    title: str
    source: str
    values: tuple[ExportedValue, ...]
    states: tuple[ExportedState, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[tuple[str, str, str], ...]  # Name, unit and meaning
    components: tuple[tuple[str, ast.expr, str], ...]  # Name, expression and equation in words
    definitions: tuple[tuple[str, ast.expr, str], ...]  # Name, expression and meaning, in the order of computation
    rates: tuple[ast.expr, ...]  # Of each state, in its unit per second
    shown: tuple[ast.expr, ...]  # Of each output, in its unit


def exported_twin(posterior: Posterior) -> ExportedTwin:
    """Return the twin with the values, components and the state that are known.

    Raises:
        ValueError: no window has been learned from yet, or the equations are those of an FMU.
    """
    if posterior.problem.base_model.fmu is not None:
        raise ValueError("its equations are in an FMU, which other tools import as it is")
    return _Export(posterior).twin()


class _Export:
    """Collects the parts of an export."""

    def __init__(self, posterior: Posterior) -> None:
        self._posterior = posterior.at_last_record()
        self._problem, phase = posterior.problem, posterior.phase
        self._start = 0.0 if phase is None else phase.next_start - (self._problem.window.sample_period or 0.0)
        self._base = self._problem.base_model
        self._scales = {name: to_base(unit)[0] for name, unit in self._base.units().items()}
        taken = {*self._base.units(), *(name for name, _, _ in self._base.definitions), TIME}
        self._names = [
            free_name(re.sub(r"\W+", "_", f"{item.site}_{item.family}"), taken) for item in self._problem.components
        ]
        self._angles = {
            item.source: free_name(f"angle_{item.source[6:-1]}", taken)
            for item in self._problem.components
            if item.source.startswith("angle(")
        }

    def twin(self) -> ExportedTwin:
        """Return everything together; raises as :func:`exported_twin`."""
        base, scales = self._base, self._scales
        measured = {name: _scaled(ast.Name(name), scale) for name, scale in scales.items()}
        sensors = self._sensor_errors(measured)
        true = {name: _minus(tree, sensors.get(name)) for name, tree in measured.items()}
        true |= {name: measured[name] for name in scales if name not in {item.name for item in base.inputs}}
        entering = self._entering(true)
        definitions = self._definitions(true, entering)
        right = {
            left: _with(_filled(parse(text), true), entering.get(left), self._mode(left))
            for left, text in base.equations
        }
        rates = [_scaled(right[f"der({state.name})"], 1.0 / scales[state.name]) for state in base.states]
        rates += [measured[source[6:-1]] for source in self._angles]
        states = {state.name for state in base.states}
        shown = []
        for output in base.outputs:
            factor, error = 1.0 / scales[output.name], sensors.get(output.name)
            own = ast.Name(output.name) if output.name in states else _scaled(right[output.name], factor)
            shown.append(own if error is None else _plus(own, _scaled(error, factor)))
        meanings = {name: meaning for name, _, meaning in base.definitions}
        return ExportedTwin(
            title=base.title,
            source=base.source,
            values=self._values(),
            states=self._states(),
            inputs=base.inputs,
            outputs=tuple((item.name, item.unit, item.meaning) for item in base.outputs),
            components=tuple(self._components(measured)),
            definitions=tuple((name, tree, meanings[name]) for name, tree in definitions.items()),
            rates=tuple(rates),
            shown=tuple(shown),
        )

    def _values(self) -> tuple[ExportedValue, ...]:
        """Return parameters, constants, and the values of components."""
        problem, prior = self._problem, self._posterior.prior()
        known = dict(problem.known) | supposed_values(self._posterior)
        free = {item.name: index for index, item in enumerate(problem.free)}
        found = []
        for item in self._base.parameters:
            index = free.get(item.name)
            is_given = item.name in known or index is None
            value, sd = (known[item.name], 0.0) if is_given else (float(prior.mean[index]), float(prior.sd[index]))
            found.append(ExportedValue(item.name, value, sd, item.unit, item.meaning))
        found += [
            ExportedValue(item.name, item.value, 0.0, item.unit, item.meaning, is_constant=True)
            for item in self._base.constants
        ]
        for slot in range(len(problem.components)):
            for suffix, index in zip(("amplitude", "inner", "phase"), indices(problem, slot), strict=False):
                item, values = problem.free[index], (float(prior.mean[index]), float(prior.sd[index]))
                found.append(ExportedValue(f"{self._names[slot]}_{suffix}", *values, item.unit, item.meaning))
        return tuple(found)

    def _states(self) -> tuple[ExportedState, ...]:
        reached = last_state(self._posterior)
        found = [
            ExportedState(item.name, item.unit, item.meaning, float(value), max(abs(item.low), abs(item.high)))
            for item, value in zip(self._base.states, reached, strict=False)
        ]
        for source, name in self._angles.items():
            unit = source_of(self._base, source).unit
            found.append(ExportedState(name, unit, f"integral of {source[6:-1]} since the first record", 0.0, 1.0))
        return tuple(found)

    def _order(self) -> list[tuple[str, ast.expr]]:
        """Return the definitions, each after those that it uses."""
        pending = {name: parse(text) for name, text, _ in self._base.definitions}
        ordered = []
        while pending:
            ready = [name for name, tree in pending.items() if not _names_in(tree) & pending.keys()]
            ordered += [(name, pending.pop(name)) for name in ready]
        return ordered

    def _definitions(self, known: Expressions, entering: Expressions) -> dict[str, ast.expr]:
        """Return the definitions in the order of computation, with what enters at them; they name those before."""
        return {name: _with(_filled(tree, known), entering.get(name), self._mode(name)) for name, tree in self._order()}

    def _mode(self, left: str) -> str:
        """Return how a component enters the right side of ``left``."""
        return next((site.mode for site in self._base.sites if site.into == left), "additive")

    def _components(self, known: Expressions) -> Iterator[tuple[str, ast.expr, str]]:
        """Yield name, expression and equation of each component, in the unit of its site."""
        values, offsets = self._posterior.prior().mean, time_offsets(self._problem, self._start)
        for slot, component in enumerate(self._problem.components):
            name, at = self._names[slot], indices(self._problem, slot)
            source = self._source(component, known, offsets.get(shift_setting(slot), 0.0))
            text = component.model.formula.replace("absolute(", "abs(").replace("Max(", "max(")
            given: dict[str, ast.expr] = {"x": source, "a": ast.Name(f"{name}_amplitude")}
            given |= {"b": ast.Name(f"{name}_inner"), "c": ast.Name(f"{name}_phase")}
            words = f"{component.key}: {equation(self._base, component, values[at].tolist())}"
            yield name, _filled(parse(text), given), words

    def _source(self, component: Component, known: Expressions, shift: float) -> ast.expr:
        """Return what a component depends on, in its unit."""
        if component.source == "t":
            return _plus(ast.Name(TIME), ast.Constant(shift)) if shift else ast.Name(TIME)
        if component.source in self._angles:
            return ast.Name(self._angles[component.source])
        own = {item.name for item in self._base.states} | {item.name for item in self._base.inputs}
        if component.source in own or not component.source:
            return ast.Name(component.source or TIME)
        expanded = dict(known)
        for name, tree in self._order():
            expanded[name] = _filled(tree, expanded)
        right = dict(self._base.equations)[component.source]
        return _scaled(_filled(parse(right), expanded), 1.0 / self._scales[component.source])

    def _terms(self, known: Expressions) -> Iterator[tuple[Site, ast.expr]]:
        """Yield site and value of each component in coherent units, with what the site multiplies it by."""
        for name, component in zip(self._names, self._problem.components, strict=True):
            site = site_of(self._base, component.site)
            value = _scaled(ast.Name(name), to_base(site.unit)[0])
            is_plain = site.through == "1" or site.mode == "multiplicative"
            yield site, value if is_plain else _times(_filled(parse(site.through), known), value)

    def _entering(self, known: Expressions) -> dict[str, ast.expr]:
        """Return what enters at the author's sites, by the left side."""
        return _sums((site.into, term) for site, term in self._terms(known) if site in self._base.sites)

    def _sensor_errors(self, known: Expressions) -> dict[str, ast.expr]:
        """Return what the sensor of each signal adds to it, in coherent units."""
        return _sums((site.into, term) for site, term in self._terms(known) if site not in self._base.sites)


def _sums(terms: Iterable[tuple[str, ast.expr]]) -> dict[str, ast.expr]:
    found: dict[str, ast.expr] = {}
    for left, term in terms:
        found[left] = _plus(found[left], term) if left in found else term
    return found


def _names_in(tree: ast.expr) -> set[str]:
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


class _Filled(ast.NodeTransformer):
    def __init__(self, known: Expressions) -> None:
        self._known = known

    def visit_Call(self, node: ast.Call) -> ast.Call:
        """Keep the name of the function."""
        arguments = [self.visit(argument) for argument in node.args]
        return ast.Call(node.func, arguments, [])

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return what stands for a name."""
        return self._known.get(node.id, node)


def _filled(tree: ast.expr, known: Expressions) -> ast.expr:
    """Return an expression with ``known`` ones in place of names."""
    filled: ast.expr = _Filled(known).visit(copy.deepcopy(tree))
    return filled


def _scaled(tree: ast.expr, factor: float) -> ast.expr:
    return tree if factor == 1.0 else _times(ast.Constant(factor), tree)


def _plus(left: ast.expr, right: ast.expr) -> ast.expr:
    return ast.BinOp(left, ast.Add(), right)


def _minus(left: ast.expr, right: ast.expr | None) -> ast.expr:
    return left if right is None else ast.BinOp(left, ast.Sub(), right)


def _times(left: ast.expr, right: ast.expr) -> ast.expr:
    return ast.BinOp(left, ast.Mult(), right)


def _with(side: ast.expr, entering: ast.expr | None, mode: str) -> ast.expr:
    """Return a right side with what enters there (Eq. 3 and 18 of the paper)."""
    if entering is None:
        return side
    return _plus(side, entering) if mode == "additive" else _times(side, _plus(ast.Constant(1), entering))
