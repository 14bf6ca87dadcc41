"""What a machine file rules out of the search for components."""

from collections.abc import Callable

from otolith.adaptation.component import key_of
from otolith.errors import nearest
from otolith.settings import DiscoveryTable
from otolith.twin.definition import Definition
from otolith.twin.metamodels import NAMES
from otolith.twin.slots import sources


def excluded(table: DiscoveryTable, twin: Definition, fail: Callable[[str, str], None]) -> frozenset[str]:
    """Keys of components that are not to be looked for; ``fail`` is told the key of the table and what is wrong."""
    places = [entry.name for entry in twin.sites]
    inputs = [entry.name for entry in sources(twin) if entry.name]
    asked = (("families", table.families, NAMES), ("sites", table.sites, places), ("inputs", table.inputs, inputs))
    for key, names, known in asked:
        for name in names or ():
            if name not in known:
                fail(key, f"{name!r} is none of them: {nearest(name, list(known))}")
    return frozenset(
        key_of(site, family, source.name)
        for site in places
        for family in NAMES
        for source in sources(twin)
        if (table.families is not None and family not in table.families)
        or (table.sites is not None and site not in table.sites)
        or (table.inputs is not None and bool(source.name) and source.name not in table.inputs)
    )
