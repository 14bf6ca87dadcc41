"""What persons do with an event: acknowledge, shelve or comment it, after ISA-18.2 and IEC 62682.

A shelved condition is silent until a stated time, also if it ends and begins again meanwhile. It is silent no more as
soon as its level is worse than when it was shelved, or its diagnosis another one. The states of parts and machine stay
as they are. Times are those of the windows.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from pydantic import Field

from otolith.health.limits import Level
from otolith.health.schema import EventChange, EventDocument, NoteDocument
from otolith_drivers.config_files import DocumentModel

# Thresholds: docs/reference/thresholds-health.md has the origin of each.
MAX_COMMENTS = 20  # of an event that its document has; the history has all
MAX_NOTE = 500  # characters of a reason or comment
MAX_NAME = 100  # characters of a person's name
MIN_SHELF, MAX_SHELF = 1.0, 7 * 86_400.0  # s for which a condition may be shelved at once


class Deed(StrEnum):
    """What a person did."""

    ACKNOWLEDGE = "acknowledge"
    SHELVE = "shelve"
    UNSHELVE = "unshelve"
    COMMENT = "comment"


CHANGES = {
    Deed.ACKNOWLEDGE: EventChange.ACKNOWLEDGED,
    Deed.SHELVE: EventChange.SHELVED,
    Deed.UNSHELVE: EventChange.UNSHELVED,
    Deed.COMMENT: EventChange.COMMENTED,
}


class OperatorNote(DocumentModel):
    """What a person did with one event."""

    id: str  # Of this note: each is applied once
    deed: Deed
    event: str  # Id of the event
    by: str = Field(max_length=MAX_NAME)
    at: float  # Unix s, or service time as :meth:`at_time` returns it
    text: str = Field(default="", max_length=MAX_NOTE)
    seconds: float | None = Field(default=None, gt=0.0, le=MAX_SHELF)  # For which it is shelved
    ended: EventDocument | None = None  # The event as it is to be published, if it was over already; service times

    def at_time(self, time: float) -> "OperatorNote":
        """Return the note as it was made at another ``time``."""
        return self.model_copy(update={"at": time})

    @property
    def document(self) -> NoteDocument:
        """What an event has of it."""
        until = None if self.seconds is None else self.at + self.seconds
        return NoteDocument(by=self.by, at=self.at, text=self.text, until=until)


@dataclass(frozen=True, slots=True)
class Shelf:
    """A shelved condition. Plain: it pickles."""

    note: NoteDocument
    state: Level  # Of the event when it was shelved
    condition_id: str

    def hides(self, event: EventDocument, now: float) -> bool:
        """Whether an event of its condition is silent: not after its time, and nothing that is new or worse."""
        is_known = event.state.rank <= self.state.rank and _is_within(event.condition_id, self.condition_id)
        return is_known and self.lasts(now)

    def lasts(self, now: float) -> bool:
        """Whether its time is not over."""
        return self.note.until is not None and now < self.note.until


def noted(
    event: EventDocument,
    before: EventDocument | None,
    shelf: Shelf | None,
    notes: Iterable[OperatorNote],
    now: float,
) -> tuple[EventDocument, Shelf | None]:
    """Return an event with the ``notes`` of persons, and the shelf of its condition.

    ``before`` is the event in the report before; ``shelf`` is that of its condition until ``now``.
    """
    if before is not None and _is_other(event, before):
        event = event.model_copy(update={"acknowledged": None})
    if shelf is not None and not shelf.hides(event, now):
        shelf = None
    change, was_shelved = None, event.shelved is not None
    for note in notes:
        own = note.document
        if note.deed is Deed.SHELVE and not Shelf(own, event.state, event.condition_id).lasts(now):
            continue  # it came late: its time is over
        if note.deed is Deed.ACKNOWLEDGE:
            event = event.model_copy(update={"acknowledged": own})
        elif note.deed is Deed.COMMENT:
            event = commented(event, own)
        else:
            shelf = Shelf(own, event.state, event.condition_id) if note.deed is Deed.SHELVE else None
            was_shelved = was_shelved or note.deed is Deed.UNSHELVE
        change = CHANGES[note.deed]
    if was_shelved and shelf is None:  # whatever else was done with it: persons are told that it is back
        change = EventChange.UNSHELVED
    return event.model_copy(update={"change": event.change or change, "shelved": shelf and shelf.note}), shelf


def _is_other(event: EventDocument, before: EventDocument) -> bool:
    """Whether an event is worse than ``before``, or has another diagnosis: nobody has seen that yet."""
    return event.state.rank > before.state.rank or not _is_within(event.condition_id, before.condition_id)


def _is_within(condition_id: str, known: str) -> bool:
    """Whether a diagnosis names no other condition than the ``known`` one: of alternatives some may be ruled out."""
    return condition_id == known or set(condition_id.split()) <= set(known.split())


def commented(event: EventDocument, note: NoteDocument) -> EventDocument:
    """Return an event with one more comment."""
    return event.model_copy(update={"comments": (*(event.comments or ()), note)[-MAX_COMMENTS:]})


Events = tuple[EventDocument, ...]


def ended_events(notes: Sequence[OperatorNote], dropped: Iterable[EventDocument]) -> tuple[Events, Events]:
    """Return the ``dropped`` events, and those that were over when persons commented on them, with the comments."""
    ended = {note.event: note.ended for note in notes if note.ended is not None}  # the last has all comments
    update = {"change": EventChange.COMMENTED, "sequence": None, "previous": None}
    over = tuple(event.model_copy(update=update) for event in ended.values())
    return tuple(_with_comments(event, of_event(notes, event.id)) for event in dropped), over


def _with_comments(event: EventDocument, notes: Iterable[OperatorNote]) -> EventDocument:
    for note in notes:
        event = commented(event, note.document) if note.deed is Deed.COMMENT else event
    return event


def of_event(notes: Iterable[OperatorNote], event_id: str) -> list[OperatorNote]:
    """Return the notes about one event, in their order."""
    return [note for note in notes if note.event == event_id and note.ended is None]


def shelved_until(events: Collection[EventDocument]) -> float | None:
    """Return until when all of ``events`` are shelved; None if one of them is not, or there is none."""
    ends = [event.shelved.until for event in events if event.shelved is not None and event.shelved.until is not None]
    return min(ends) if ends and len(ends) == len(events) else None


def lasting(shelves: Mapping[str, Shelf], notes: Iterable[OperatorNote], now: float) -> dict[str, Shelf]:
    """Return the shelves that neither their time nor a person has ended; by key, as the ids of events begin."""
    ended = {note.event.rpartition("@")[0] for note in notes if note.deed is Deed.UNSHELVE}
    return {key: shelf for key, shelf in shelves.items() if shelf.lasts(now) and key not in ended}
