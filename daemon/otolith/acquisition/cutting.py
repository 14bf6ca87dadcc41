"""Cut a window from its samples: records, bridged inputs and quality.

This takes milliseconds and imports SciPy, so the service does it in its worker.
"""

from dataclasses import replace
from typing import NamedTuple

from otolith.acquisition.quality import assess_quality
from otolith.acquisition.records import make_records
from otolith.acquisition.window import Window
from otolith.acquisition.windower import RawWindow


class CutWindow(NamedTuple):
    """A window, and what none of its records has."""

    window: Window
    stale: int  # Readings of a register that had not been renewed


def cut(raw: RawWindow) -> CutWindow:
    """Return the window of these samples."""
    plans, samples, labelled = dict(raw.plans), raw.samples, raw.span.start + (raw.offset + raw.ahead)
    records = replace(make_records(samples.series, plans, raw.span), ambiguous=samples.ambiguous)
    window = Window(
        index=raw.index,
        start=raw.span.start + raw.offset,
        grid=records.grid,
        signals=tuple(plans),
        values=records.values,
        missing=records.missing,
        quality=assess_quality(records, plans, samples.cyclic, raw.limits, replace(raw.span, start=labelled)),
        bridge_error=records.bridge_error,
        observed=raw.observed,
        ahead=raw.ahead,
    )
    return CutWindow(window, records.stale)
