"""The connection to the machine in a report: its sources, and what is not known because one of them is silent."""

from collections.abc import Collection, Mapping
from dataclasses import asdict

from otolith.acquisition.window import Window
from otolith.health.schema import DriverDocument, ParameterDocument, SourceDocument, Status
from otolith_drivers.base import Link


def driver_document(link: Link) -> DriverDocument:
    """Return the document of a connection."""
    sources = {
        state.name: SourceDocument(
            signals=state.signals,
            up=state.link.up,
            reason=state.link.reason,
            warnings=state.link.warnings,
            **asdict(state.counters),
        )
        for state in link.sources
    }
    return DriverDocument(up=link.up, reason=link.reason, warnings=link.warnings, plan=link.plan, sources=sources)


def absent_sources(link: Link, window: Window, outputs: Collection[str]) -> dict[str, str]:
    """Return by name which of several sources are down or gave no sample in the window, in words.

    A source that only has commands may be silent: none of them has changed.
    """
    absent = {}
    for state in link.sources:
        is_expected = bool(state.link.warnings) or not set(state.signals).isdisjoint(outputs)
        what = f"source {state.name!r} ({', '.join(state.signals)})"
        if not state.link.up:
            absent[state.name] = f"{what} is down: {state.link.reason}"
        elif is_expected and all(window.missing_in(name).all() for name in state.signals if name in window.signals):
            silent = f"is silent: {state.link.warnings[0]}" if state.link.warnings else "sent nothing in this window"
            absent[state.name] = f"{what} {silent}"
    return absent


def with_absent_sources(
    parameters: Mapping[str, ParameterDocument], absent: Mapping[str, str] | None
) -> dict[str, ParameterDocument]:
    """Return ``parameters``; each that this window did not estimate names the absent sources in its reason."""
    return {
        name: parameter
        if parameter.status is Status.ESTIMATED or not absent
        else parameter.model_copy(update={"reason": "; ".join([*absent.values(), parameter.reason])})
        for name, parameter in parameters.items()
    }
