"""The connection to the machine in a report: its sources, and what is not known because one of them is silent."""

from collections.abc import Mapping

import numpy as np

from otolith.health.schema import DriverDocument, ParameterDocument, SourceDocument, Status, Traces
from otolith_drivers.base import Link


def driver_document(link: Link) -> DriverDocument:
    """Return the document of a connection."""
    sources = {
        state.name: SourceDocument(
            signals=state.signals,
            up=state.link.up,
            reason=state.link.reason,
            warnings=state.link.warnings,
            received=state.counters.received,
            bad=state.counters.bad,
            lost=state.counters.lost,
            reconnects=state.counters.reconnects,
        )
        for state in link.sources
    }
    return DriverDocument(up=link.up, reason=link.reason, warnings=link.warnings, plan=link.plan, sources=sources)


def with_missing_sources(
    parameters: Mapping[str, ParameterDocument], driver: DriverDocument, traces: Traces
) -> dict[str, ParameterDocument]:
    """Return ``parameters``; each that this window did not estimate has in its reason which sources gave no sample."""
    silent = "; ".join(
        f"{', '.join(source.signals)} missing, because source {name!r} {_why(source)}"
        for name, source in driver.sources.items()
        if _is_silent(source, traces)
    )
    if not silent:
        return dict(parameters)
    return {
        name: parameter
        if parameter.status is Status.ESTIMATED
        else parameter.model_copy(update={"reason": f"{silent}; {parameter.reason}"})
        for name, parameter in parameters.items()
    }


def _is_silent(source: SourceDocument, traces: Traces) -> bool:
    """Whether no signal of the source has a sample in the window; a command may have none because it did not change."""
    outputs = dict(zip(traces.outputs, traces.measured.T, strict=True))
    values = outputs | dict(zip(traces.inputs, traces.driving.T, strict=True))
    is_expected = not source.up or bool(source.warnings) or not set(source.signals).isdisjoint(outputs)
    return is_expected and not any(np.isfinite(values[signal]).any() for signal in source.signals)


def _why(source: SourceDocument) -> str:
    if not source.up:
        return f"is down: {source.reason}"
    return f"is silent: {source.warnings[0]}" if source.warnings else "sent nothing in this window"
