"""The right sides of a definition as numbers, term by term, without a compiled kernel."""

import ast
from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.components import UNBOUNDED
from otolith.twin.definition import Definition
from otolith.twin.expressions import evaluate, names_in, parse, terms
from otolith_drivers.units import to_base


@lru_cache(maxsize=64)
def ordered_equations(base: Definition) -> tuple[list[tuple[str, ast.expr]], dict[str, float]]:
    """Return definitions and rates as trees, each after those that it uses, and the scale of every quantity."""
    pending = {name: parse(text) for name, text, _ in base.definitions}
    ordered: list[tuple[str, ast.expr]] = []
    while pending:
        ready = [name for name, tree in pending.items() if not names_in(tree) & (pending.keys() - {name})]
        ordered += [(name, pending.pop(name)) for name in ready]
    ordered += [(left, parse(text)) for left, text in base.equations if left.startswith("der(")]
    return ordered, {name: to_base(unit)[0] for name, unit in base.units().items()}


@lru_cache(maxsize=256)
def _entrance(base: Definition, site: int) -> tuple[ast.expr, float]:
    """Return the tree of what a site multiplies, and the scale of its unit."""
    entered = base.sites[site]
    return parse(entered.through), to_base(entered.unit)[0]


def rate_terms(base: Definition, columns: Mapping[str, Array], site: int = 0, entering: float = 0.0) -> list[Array]:
    """Return for each state the terms (terms, records) of its rate, in its unit per second.

    ``columns`` has every input, state and parameter, (records,) or one value, in its own unit; ``entering`` is added at
    ``site``.
    """
    ordered, scales = ordered_equations(base)
    entered = base.sites[site] if entering else None
    values = {name: [np.asarray(column) * scales[name]] for name, column in columns.items()}
    values |= {fixed.name: [np.array([fixed.value * scales[fixed.name]])] for fixed in base.constants}
    with np.errstate(all="ignore"):
        for name, tree in ordered:
            values[name] = terms(tree, values)
            if entered is None or entered.into != name:
                continue
            if entered.mode == "multiplicative":
                values[name] = [(1.0 + entering) * term for term in values[name]]
            else:
                through, scale = _entrance(base, site)
                values[name] = [*values[name], evaluate(through, values) * entering * scale]
    return [_rows(values[f"der({state.name})"], scales[state.name]) for state in base.states]


def _rows(summands: list[Array], scale: float) -> Array:
    rows = np.array(np.broadcast_arrays(*summands)) / scale
    return np.asarray(np.nan_to_num(rows, nan=0.0, posinf=UNBOUNDED, neginf=-UNBOUNDED))
