"""The connection to the machine in a report: its sources, and what is not known because one of them is down."""

from collections.abc import Mapping

from otolith.health.schema import DriverDocument, ParameterDocument, SourceDocument, Status
from otolith_drivers.base import Link


def driver_document(link: Link) -> DriverDocument:
    """Return the document of a connection."""
    sources = {
        state.name: SourceDocument(
            signals=state.signals,
            up=state.link.up,
            reason=state.link.reason,
            received=state.counters.received,
            bad=state.counters.bad,
            lost=state.counters.lost,
            reconnects=state.counters.reconnects,
        )
        for state in link.sources
    }
    return DriverDocument(up=link.up, reason=link.reason, warnings=link.warnings, plan=link.plan, sources=sources)


def with_missing_sources(
    parameters: Mapping[str, ParameterDocument], driver: DriverDocument
) -> dict[str, ParameterDocument]:
    """Return ``parameters``; each that this window did not estimate has the sources that are down in its reason."""
    down = [
        f"{', '.join(source.signals)} missing, because source {name!r} is down: {source.reason}"
        for name, source in driver.sources.items()
        if not source.up
    ]
    return {
        name: parameter.model_copy(update={"reason": "; ".join([*down, parameter.reason])})
        if down and parameter.status is not Status.ESTIMATED
        else parameter
        for name, parameter in parameters.items()
    }
