"""The events of a history in a terminal: a table with a row for each event, or each change of them as a paragraph."""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from otolith.cli.console import Terminal
from otolith.cli.operation.live_table import LEVEL_STYLES, event_style
from otolith.health.limits import Level
from otolith.health.schema import EventChange, EventDocument
from otolith.health.text import PARTS, Texts, event_text, note_texts
from otolith.health.times import clock_in, in_local_time, moment_text
from otolith_drivers.common.time_zones import comes_twice

DATE = len("2026-01-31 ")  # characters of a time before the time of day
TIMES = DATE + len("23:59:59")
NARROW_END = len("23:59:59")  # characters of the column of ends in a narrow terminal
WIDTH_WITH_ENDS = 72  # characters of a terminal whose column of ends is as wide as its texts; engineering choice
MAX_WIDTH = 120  # characters: in a wider table the end is too far from the begin; engineering choice


@dataclass(frozen=True, slots=True)
class _EventRow:
    """An event: its last change, and the most severe state that it reached."""

    event: EventDocument
    worst: Level


def event_table(changes: Iterable[EventDocument], width: int, say: Texts, newest: int | None = None) -> Table:
    """Return a table with begin, state, part, cause and end of each event of ``changes``, by their begin.

    The state is the most severe one that the event reached. With ``newest`` only so many rows. Times are local; those
    of another zone than the first, or of an hour that comes twice, name it.
    """
    rows = _rows(changes)[-(newest or 0) :]
    words = say.translated
    times = [(at, row.event.timezone) for row in rows for at in (row.event.start, row.event.end) if at is not None]
    zones = {moment_text(at, zone)[TIMES:] for at, zone in times}
    is_told = len(zones) > 1 or any(comes_twice(at, zone) for at, zone in times)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold", width=min(width, MAX_WIDTH))
    length = TIMES + max(map(len, zones)) if is_told else TIMES
    titles = [words("since"), say("state"), say("part"), say("cause"), say("is_cleared")]
    since, state, part, reason, cleared = (f"{title[:1].upper()}{title[1:]}" for title in titles)
    table.add_column(since, no_wrap=True, min_width=length)
    table.add_column(state, no_wrap=True)
    table.add_column(part, overflow="fold")
    table.add_column(reason, overflow="fold", ratio=1)
    table.add_column(cleared, width=NARROW_END if width < WIDTH_WITH_ENDS else None, overflow="fold")
    for row in rows:
        event, begin = row.event, moment_text(row.event.start, row.event.timezone)[:length]
        is_over = event.end is not None
        end = "" if event.change is EventChange.NOTED else say("not_cleared")
        if is_over and event.change is not EventChange.NOTED:
            end = moment_text(event.end or 0.0, event.timezone)[:length]
            end = end[DATE:] if end[:DATE] == begin[:DATE] else end
        worst = Text(words(row.worst), style=LEVEL_STYLES[row.worst] if not is_over else "")
        why = [say("dropped", reason=event.reason)] if event.reason else []
        cause = PARTS.join([event.condition, *why, *note_texts(event, clock_in(event.timezone))])
        table.add_row(begin, worst, say.part(event.part), cause, Text(end, style="" if is_over else "bold"))
    return table


def _rows(changes: Iterable[EventDocument]) -> list[_EventRow]:
    rows: dict[str, _EventRow] = {}
    for change in changes:
        before = rows.get(change.id)
        # An event is cleared with the state that it had: it is no state that it reached then.
        states = [change.state, *([before.worst] if before else ())]
        rows[change.id] = _EventRow(change, max(states, key=lambda level: level.rank))
    return sorted(rows.values(), key=lambda row: row.event.start)


def print_changes(
    console: Terminal, changes: Iterable[EventDocument], bundles: Mapping[int | None, Path], say: Texts
) -> None:
    """Print each change of an event as a paragraph, with the command that computes it again where there is evidence."""
    for event in changes:
        # The text of a cleared event begins with it.
        change = "" if event.end is not None else f"{say.translated(event.change or '')}: "
        console.print(f"{change}{event_text(event, details=True)}", style=event_style(event))
        if (bundle := bundles.get(event.sequence)) is not None:
            console.print(f"  otolith reproduce {shlex.quote(str(bundle))}", soft_wrap=True)


def print_findings(console: Terminal, findings: Sequence[Mapping[str, Any]], say: Texts, zone: str | None) -> None:
    """Print each finding as a paragraph, with times in a zone."""
    when = clock_in(zone)
    for finding in findings:
        values = {"first": when(finding["first"]), "last": when(finding["last"]), "count": finding["count"]}
        console.print(
            say.decimals(say("finding_of", text=in_local_time(say.translated(finding["text"]), zone), **values))
        )
