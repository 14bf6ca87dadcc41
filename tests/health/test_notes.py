"""Acknowledged, shelved and commented events: what a person did stays with the event, and hides nothing worse."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import pytest

from otolith.health.events import HealthState, assess
from otolith.health.labels import TimeLabels
from otolith.health.limits import Level
from otolith.health.notes import MAX_COMMENTS, Deed, OperatorNote
from otolith.health.schema import EventChange, EventDocument, HealthDocument, ReportDocument
from otolith.health.text import event_text, headline
from tests.health.test_events import ACT, LENGTH, PLAN, WATCH, report
from tests.messages import assert_says

WORN, BROKEN, HEALTHY = WATCH - 0.1, ACT - 0.1, 6.5  # ohm
REASON = "spare winding comes on Friday"


class Run:
    """One window after the other, and what persons do between them."""

    def __init__(self) -> None:
        self.state, self.document, self.index = HealthState(), report(0), 0
        self._given: tuple[OperatorNote, ...] = ()

    def windows(self, count: int, value: float) -> list[EventDocument]:
        """Assess windows with a value; return the changes that they published."""
        changes: list[EventDocument] = []
        for _ in range(count):
            self.state, after = assess(PLAN, self.state, report(self.index, value))
            self.document, self.index = ReportDocument.from_json(after.to_json()), self.index + 1
            changes += [event for event in self.document.events if event.change is not None]
        return changes

    def note(self, deed: Deed, text: str = "", seconds: float | None = None) -> None:
        """Give a note about the event of the resistance."""
        values = {"deed": deed, "event": self.event.id, "text": text, "seconds": seconds}
        number = len(self._given)
        note = OperatorNote(id=f"{number}", by="anna", at=self.index * LENGTH, **values)
        self._given = (*self._given, note)
        self.state = self.state.with_notes(self._given)

    @property
    def event(self) -> EventDocument:
        return next(event for event in self.document.events if event.id.startswith("limit/R_a"))

    @property
    def health(self) -> HealthDocument:
        assert self.document.health is not None
        return self.document.health


@pytest.fixture
def worn() -> Run:
    run = Run()
    run.windows(5, HEALTHY)
    run.windows(5, WORN)
    assert run.event.state is Level.WATCH
    return run


def kinds(changes: Iterable[EventDocument]) -> list[EventChange | None]:
    return [event.change for event in changes]


def test_a_note_is_published_once_and_stays_with_the_event(worn: Run) -> None:
    worn.note(Deed.ACKNOWLEDGE)
    (change,) = worn.windows(1, WORN)
    assert (change.change, change.is_silent) == (EventChange.ACKNOWLEDGED, True)
    worn.note(Deed.COMMENT, "the winding was dried")
    (change,) = worn.windows(1, WORN)
    assert change.change is EventChange.COMMENTED
    assert worn.windows(3, WORN) == []
    assert worn.event.acknowledged is not None
    assert worn.event.acknowledged.by == "anna"
    assert_says(event_text(worn.event), "acknowledged", "anna", "the winding was dried")
    (cleared,) = worn.windows(5, HEALTHY)
    assert_says(event_text(cleared), "cleared", "the winding was dried")


def test_the_words_of_a_person_are_not_translated(worn: Run) -> None:
    worn.note(Deed.COMMENT, 'the "old" one had 6.5 ohm')
    worn.windows(1, WORN)
    german = worn.event.model_copy(update={"language": "de"})
    assert_says(event_text(german), "Kommentar von anna", "the 'old' one had 6.5 ohm")


def test_what_becomes_worse_is_not_acknowledged_any_more(worn: Run) -> None:
    worn.note(Deed.ACKNOWLEDGE)
    worn.windows(1, WORN)
    (worse,) = worn.windows(4, BROKEN)
    assert (worse.change, worse.state, worse.acknowledged) == (EventChange.CHANGED, Level.ACT, None)
    worn.note(Deed.ACKNOWLEDGE)
    worn.windows(1, BROKEN)
    (better,) = worn.windows(5, WORN)
    assert (better.state, better.acknowledged is not None) == (Level.WATCH, True)


def test_a_shelved_event_comes_back_by_itself_and_its_state_stays(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=10.0 * LENGTH)
    (change,) = worn.windows(1, WORN)
    assert (change.change, change.is_silent) == (EventChange.SHELVED, True)
    assert (worn.health.state, worn.health.parts["winding"].state) == (Level.WATCH, Level.WATCH)
    assert worn.health.shelved == worn.health.parts["winding"].shelved == 20.0 * LENGTH
    assert_says(event_text(worn.event), "shelved until", "anna", REASON)
    assert_says(headline(worn.health), "WATCH", "shelved until")
    assert worn.windows(8, WORN) == []
    (change,) = worn.windows(5, WORN)
    assert (change.change, change.is_silent, change.shelved) == (EventChange.UNSHELVED, False, None)
    assert worn.health.shelved is None
    assert "shelved" not in headline(worn.health)


def test_a_shelved_condition_that_comes_again_is_silent(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=100.0 * LENGTH)
    first = worn.event.id
    changes = worn.windows(5, WORN) + worn.windows(20, HEALTHY) + worn.windows(20, WORN)
    assert kinds(changes) == [EventChange.SHELVED, EventChange.CLEARED, EventChange.RAISED]
    assert all(change.is_silent for change in changes)
    assert worn.event.id != first
    assert kinds(worn.windows(100, WORN)) == [EventChange.UNSHELVED]


@pytest.mark.parametrize("pause", [0, 20])
def test_a_shelf_hides_nothing_that_is_worse(worn: Run, pause: int) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=500.0 * LENGTH)
    worn.windows(2, WORN)
    worn.windows(pause, HEALTHY)
    worse = [change for change in worn.windows(5, BROKEN) if change.state is Level.ACT]
    assert [(change.is_silent, change.shelved) for change in worse] == [(False, None)]
    assert worn.health.shelved is None
    worn.windows(10, WORN)
    assert worn.event.shelved is None  # once it was worse


def test_a_diagnosis_of_which_alternatives_are_ruled_out_is_no_other_one(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=500.0 * LENGTH)
    worn.windows(2, WORN)
    (shelf,) = worn.state.shelves.values()
    both = f"winding-hot {shelf.condition_id}"
    worn.state = replace(worn.state, shelves={"limit/R_a": replace(shelf, condition_id=both)})
    assert worn.windows(2, WORN) == []
    assert worn.event.shelved is not None


def test_a_shelf_hides_no_other_diagnosis(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=500.0 * LENGTH)
    worn.windows(2, WORN)
    (shelf,) = worn.state.shelves.values()
    worn.state = replace(worn.state, shelves={"limit/R_a": replace(shelf, condition_id="winding-hot")})
    (change,) = worn.windows(1, WORN)
    assert (change.change, change.shelved) == (EventChange.UNSHELVED, None)


def test_another_open_event_is_not_shelved_with_it(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=500.0 * LENGTH)
    worn.windows(1, WORN)
    other = {name: document for name, document in worn.health.parts.items() if name != "winding"}
    assert all(part.shelved is None for part in other.values())


def test_a_person_ends_a_shelf(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=500.0 * LENGTH)
    worn.windows(2, WORN)
    worn.note(Deed.UNSHELVE)
    assert kinds(worn.windows(3, WORN)) == [EventChange.UNSHELVED]
    assert worn.state.shelves == {}


@pytest.mark.parametrize("deed", [Deed.COMMENT, Deed.ACKNOWLEDGE])
@pytest.mark.parametrize("by_person", [False, True])
def test_no_other_note_hides_that_an_event_is_back(worn: Run, deed: Deed, *, by_person: bool) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=500.0 * LENGTH if by_person else 2.5 * LENGTH)
    worn.windows(2, WORN)
    if by_person:
        worn.note(Deed.UNSHELVE)
    worn.note(deed, "seen")
    (change,) = worn.windows(1, WORN)
    assert (change.change, change.is_silent, change.shelved) == (EventChange.UNSHELVED, False, None)
    assert (change.acknowledged or (change.comments or (None,))[-1]) is not None


def test_what_is_shelved_again_at_once_is_not_back(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=2.5 * LENGTH)
    worn.windows(2, WORN)
    worn.note(Deed.SHELVE, REASON, seconds=100.0 * LENGTH)
    (change,) = worn.windows(1, WORN)
    assert (change.change, change.is_silent) == (EventChange.SHELVED, True)


def test_a_person_ends_a_shelf_without_an_open_event(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=500.0 * LENGTH)
    worn.windows(1, WORN)
    (cleared, *_) = worn.windows(20, HEALTHY)
    note = OperatorNote(id="x", deed=Deed.UNSHELVE, event=cleared.id, by="anna", at=0.0)
    worn.state = worn.state.with_notes((note,))
    assert kinds(worn.windows(1, HEALTHY)) == []
    (raised,) = worn.windows(5, WORN)
    assert (raised.change, raised.is_silent) == (EventChange.RAISED, False)


def test_what_the_daemon_has_taken_over_is_not_done_again(worn: Run) -> None:
    worn.note(Deed.COMMENT, "once")
    worn.windows(1, WORN)
    worn.note(Deed.COMMENT, "twice")
    worn.windows(1, WORN)
    assert [note.text for note in worn.event.comments or ()] == ["once", "twice"]


def test_the_last_comments_are_in_the_event(worn: Run) -> None:
    for number in range(MAX_COMMENTS + 5):
        worn.note(Deed.COMMENT, f"number {number}")
        worn.windows(1, WORN)
    texts: Sequence[str] = [note.text for note in worn.event.comments or ()]
    assert texts == [f"number {number}" for number in range(5, MAX_COMMENTS + 5)]


def test_an_event_that_is_over_takes_a_comment(worn: Run) -> None:
    (cleared,) = worn.windows(5, HEALTHY)
    note = OperatorNote(
        id="x", deed=Deed.COMMENT, event=cleared.id, by="anna", at=1.0, text="it was the test bench", ended=cleared
    )
    worn.state = worn.state.with_notes((note,))
    (change,) = worn.windows(1, HEALTHY)
    assert (change.id, change.change, change.end) == (cleared.id, EventChange.COMMENTED, cleared.end)
    assert (worn.health.state, change.is_silent) == (Level.OK, True)
    assert worn.windows(2, HEALTHY) == []


def test_a_dropped_state_closes_its_events_with_their_notes(worn: Run) -> None:
    worn.note(Deed.COMMENT, "known")
    worn.note(Deed.SHELVE, REASON, seconds=500.0 * LENGTH)
    worn.windows(1, WORN)
    worn.state = worn.state.without_learned("the operator reset what was learned")
    (cleared,) = worn.windows(1, HEALTHY)
    assert cleared.change is EventChange.CLEARED
    assert [note.text for note in cleared.comments or ()] == ["known"]
    assert worn.state.shelves == {}
    worn.note(Deed.COMMENT, "too late") if worn.document.events else None
    assert [change for change in worn.windows(1, HEALTHY) if change.change is EventChange.COMMENTED] == []


def test_what_a_person_wrote_as_a_state_is_dropped_stays_with_its_events(worn: Run) -> None:
    """As one that rejects a component, whose event ends because of that, says who did it."""
    worn.note(Deed.COMMENT, "rejected")
    worn.state = worn.state.without_learned("the operator reset what was learned")
    (cleared,) = worn.windows(1, HEALTHY)
    assert cleared.change is EventChange.CLEARED
    assert [note.by for note in cleared.comments or ()] == ["anna"]


def test_times_of_notes_are_labels(worn: Run) -> None:
    worn.note(Deed.SHELVE, REASON, seconds=100.0)
    worn.note(Deed.COMMENT, "a word")
    worn.windows(1, WORN)
    labels = TimeLabels(((0.0, 1e9),))
    event, health = labels.of_event(worn.event), labels.of_report(worn.document).health
    assert event.shelved is not None
    assert worn.event.shelved is not None
    assert (event.shelved.at, event.shelved.until) == (worn.event.shelved.at + 1e9, worn.event.shelved.at + 1e9 + 100.0)
    assert [note.at for note in event.comments or ()] == [worn.event.shelved.at + 1e9]
    assert health is not None
    assert health.shelved == event.shelved.until


@pytest.mark.parametrize("words", ["since 2026-01-31 12:00:00 UTC", 'a 3" pipe, since 2026-01-31 12:00:00 UTC'])
def test_the_words_of_a_person_keep_their_times(worn: Run, words: str) -> None:
    worn.note(Deed.COMMENT, words)
    worn.windows(1, WORN)
    own = "R_a 5 Ω since 2026-01-30 12:00:00 UTC"
    text = event_text(worn.event.model_copy(update={"timezone": "Europe/Berlin", "text": own}))
    assert "2026-01-31 12:00:00 UTC" in text
    assert "2026-01-30 13:00:00 CET" in text
