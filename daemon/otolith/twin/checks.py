"""Whether the equations of a page can be meant: known symbols, no loops, the same dimension on both sides."""

import ast
from collections.abc import Callable, Mapping
from typing import Any

from otolith.errors import nearest
from otolith.twin.definition import Definition, Site
from otolith.twin.dimensions import NONE, describe, dimension_of, measure
from otolith.twin.expressions import ExpressionError, check_known, names, parse
from otolith_drivers.toml_files import Location

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
