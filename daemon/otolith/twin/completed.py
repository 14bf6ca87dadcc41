"""The algebra of slots: what enters at each site of a twin with slots (see :mod:`otolith.twin.slots`)."""

from collections.abc import Mapping

import sympy

from otolith.twin.definition import Definition
from otolith.twin.functions import component
from otolith.twin.slots import SLOTS, enters, family, numbers, place, shift, sites, sources, weight
from otolith_drivers.quantities import to_base


def entering_of(
    plain: Definition, symbols: Mapping[str, sympy.Symbol], outputs: Mapping[str, sympy.Expr]
) -> list[sympy.Expr]:
    """For each site of ``plain``, in its order, the sum of what enters there, in coherent units.

    ``outputs`` are those of the plain twin in the units of the page: a component that depends on one would otherwise
    depend on itself.
    """
    components = [_component(plain, slot, symbols, outputs) for slot in range(SLOTS)]
    found = []
    for index, site in enumerate(sites(plain)):
        terms = [symbols[place(slot, index)] * entry for slot, entry in enumerate(components)]
        scale = to_base(site.unit)[0]
        total = sympy.Add(symbols[enters(index)], *terms)
        found.append(total if scale == 1.0 else sympy.Float(scale) * total)
    return found


def _component(
    plain: Definition, slot: int, symbols: Mapping[str, sympy.Symbol], outputs: Mapping[str, sympy.Expr]
) -> sympy.Expr:
    states = {entry.name for entry in plain.states}
    terms = [symbols[shift(slot)]]
    for index, source in enumerate(sources(plain)):
        if source.symbol:
            is_output = source.name in outputs and source.name not in states
            value = outputs[source.name] if is_output else symbols[source.symbol]
            terms.append(symbols[weight(slot, index)] * value)
    amplitude, inner, phase = (symbols[name] for name in numbers(slot))
    return component(symbols[family(slot)], sympy.Add(*terms), amplitude, inner, phase)
