"""The right sides of a definition as numbers, term by term, without a compiled kernel."""

import ast
from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.components import UNBOUNDED
from otolith.twin.definition import Definition
from otolith.twin.expressions import evaluate, names_in, parse, row_of_fmu, terms
from otolith_drivers.units import to_base


@lru_cache(maxsize=64)
def ordered_equations(base: Definition) -> tuple[list[tuple[str, ast.expr]], dict[str, float]]:
    """Return definitions, then rates and outputs, as trees, each after those that it uses, and all scales of units."""
    pending = {name: parse(text) for name, text, _ in base.definitions}
    ordered: list[tuple[str, ast.expr]] = []
    while pending:
        ready = [name for name, tree in pending.items() if not names_in(tree) & (pending.keys() - {name})]
        ordered += [(name, pending.pop(name)) for name in ready]
    ordered += [(left, parse(text)) for left, text in base.equations]
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
    values, scales = _evaluated(base, columns, site, np.array([entering]))
    return [_rows(values[f"der({state.name})"], scales[state.name]) for state in base.states]


def right_sides(base: Definition, columns: Mapping[str, Array], site: int, entering: Array) -> Array:
    """Return the right sides of all equations (equations, records), as ``rate_terms``; ``entering`` is (records,)."""
    values, scales = _evaluated(base, columns, site, entering)
    names = [left.removeprefix("der(").removesuffix(")") for left, _ in base.equations]
    rows = [
        _rows(values[left], scales[name]).sum(axis=0) for (left, _), name in zip(base.equations, names, strict=True)
    ]
    return np.array(np.broadcast_arrays(*rows))


def _evaluated(
    base: Definition, columns: Mapping[str, Array], site: int, entering: Array
) -> tuple[dict[str, list[Array]], dict[str, float]]:
    """Return the terms of every quantity and right side, in base units, and the scales of the units."""
    ordered, scales = ordered_equations(base)
    entered = base.sites[site] if entering.any() else None
    values = {name: [np.asarray(column) * scales[name]] for name, column in columns.items()}
    values |= {fixed.name: [np.array([fixed.value * scales[fixed.name]])] for fixed in base.constants}
    with np.errstate(all="ignore"):
        for name, tree in ordered:
            row = row_of_fmu(tree)
            values[name] = terms(tree, values) if row is None else [_of_fmu(base, tree, values)[row]]
            if entered is None or entered.into != name:
                continue
            if entered.mode == "multiplicative":
                values[name] = [(1.0 + entering) * term for term in values[name]]
            else:
                through, scale = _entrance(base, site)
                values[name] = [*values[name], evaluate(through, values) * entering * scale]
    return values, scales


def _of_fmu(base: Definition, tree: ast.expr, values: Mapping[str, list[Array]]) -> Array:
    """Return what the FMU of a twin computes (rows, records) from the arguments of a call, in coherent units."""
    if base.fmu is None or not isinstance(tree, ast.Call):
        raise ValueError(f"twin {base.name!r} has no FMU")
    from otolith.fmu.instance import instance_of  # noqa: PLC0415 - loads Numba, which the daemon does not need

    columns = np.broadcast_arrays(*(evaluate(argument, values) for argument in tree.args[1:]))
    return np.asarray(instance_of(base.fmu).rows(np.column_stack(columns)).T)


def _rows(summands: list[Array], scale: float) -> Array:
    rows = np.array(np.broadcast_arrays(*summands)) / scale
    return np.asarray(np.nan_to_num(rows, nan=0.0, posinf=UNBOUNDED, neginf=-UNBOUNDED))
