"""``otolith history --events``: a row for each event, in the order of time, within the width of the terminal."""

import io

import pytest

from otolith.cli.console import Terminal
from otolith.cli.operation.event_table import event_table
from otolith.health.limits import Level
from otolith.health.schema import EventChange, EventDocument
from otolith.health.text import texts_in
from otolith.health.times import moment_text
from tests.storage.histories import event

BEGIN = 1_700_000_000.0  # Unix s, 2023-11-14 22:13:20 UTC
RAISED, CHANGED, CLEARED, NOTED = EventChange.RAISED, EventChange.CHANGED, EventChange.CLEARED, EventChange.NOTED


def change(key: str, of: EventChange, state: Level, start: float, **values: object) -> EventDocument:
    return event(0, BEGIN + start, of).model_copy(update={"id": key, "state": state, "since": BEGIN + start, **values})


def lines(changes: list[EventDocument], width: int = 80, newest: int | None = None) -> list[str]:
    console = Terminal(file=io.StringIO(), width=width)
    console.print(event_table(changes, width, texts_in("en"), newest))
    written = console.file.getvalue()  # type: ignore[attr-defined]
    return [line.rstrip() for line in written.splitlines() if "2023-" in line or ":" in line]


def test_an_event_is_one_row_with_its_worst_state_and_its_end() -> None:
    later = change("a", RAISED, Level.WATCH, 100.0)
    rows = lines(
        [
            change("b", RAISED, Level.WATCH, 50.0, part="shaft"),
            later,
            change("a", CHANGED, Level.ACT, 100.0),
            change("a", CLEARED, Level.WATCH, 100.0, end=BEGIN + 160.0),
            change("c", NOTED, Level.OK, 200.0, part="clock", end=BEGIN + 200.0),
        ]
    )
    assert [row.split()[0:4] for row in rows] == [
        ["2023-11-14", "22:14:10", "WATCH", "shaft"],
        ["2023-11-14", "22:15:00", "ACT", "winding"],
        ["2023-11-14", "22:16:40", "OK", "clock"],
    ]
    assert rows[0].endswith("not cleared")
    assert rows[1].endswith(" 22:16:00")
    assert rows[2].endswith("turns")  # what happened at one moment is neither open nor cleared


def test_an_end_on_another_day_has_its_date() -> None:
    (row, *_) = lines([change("a", CLEARED, Level.ACT, 0.0, end=BEGIN + 86_400.0)], 120)
    assert row.endswith("2023-11-15 22:13:20")


@pytest.mark.parametrize("width", [60, 80, 120])
def test_it_is_within_the_width_and_cuts_no_time(width: int) -> None:
    long = "inter-turn short circuit, or a winding that is colder than its nominal value is for, or a faulty sensor"
    rows = lines([change(str(at), RAISED, Level.NO_DATA, at, condition=long) for at in (0.0, 10.0)], width)
    assert all(len(row) <= width for row in rows)
    assert sum("2023-11-14 22:13:" in row for row in rows) == 2
    assert not any("…" in row for row in rows)


def test_only_the_newest_are_shown_where_there_is_little_room() -> None:
    rows = lines([change(str(at), RAISED, Level.WATCH, at) for at in range(9)], newest=2)
    assert [row.split()[1] for row in rows] == ["22:13:27", "22:13:28"]


def test_times_of_two_zones_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:

    def changing(seconds: float, _: str | None) -> str:
        return f"{moment_text(seconds)[:19]} {'CET' if seconds < BEGIN + 5 else 'CEST'}"

    monkeypatch.setattr("otolith.cli.operation.event_table.moment_text", changing)
    rows = lines([change(str(at), RAISED, Level.WATCH, at) for at in (0.0, 10.0)])
    assert [row.split()[2] for row in rows] == ["CET", "CEST"]


def test_it_is_in_the_language_of_the_machine() -> None:
    console = Terminal(file=io.StringIO(), width=80)
    console.print(event_table([change("a", RAISED, Level.ACT, 0.0, language="de")], 80, texts_in("de")))
    written = console.file.getvalue()  # type: ignore[attr-defined]
    assert {"Seit", "Zustand", "Teil", "Ursache", "Behoben", "HANDELN", "nicht"} <= set(written.split())
