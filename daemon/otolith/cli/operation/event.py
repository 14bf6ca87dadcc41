"""``otolith event``: what a person does with an event: acknowledge, shelve or comment it, after ISA-18.2."""

import os
import pwd
import re
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.common import AS_JSON, local_time
from otolith.cli.machines import reader_of
from otolith.cli.operation.history import SPANS
from otolith.cli.terminal import echo, echo_json
from otolith_drivers.outside_text import SURROGATE

if TYPE_CHECKING:
    from otolith.health.labels import TimeLabels
    from otolith.health.notes import OperatorNote, Shelf
    from otolith.health.schema import EventDocument
    from otolith.storage.decisions import DecisionsFile

MAX_ACCOUNT = 32  # characters of the name of a user. Source: useradd(8)
MACHINE = click.argument("machine", metavar="FILE|MACHINE")
EVENT = click.argument("event")


@click.group()
def event() -> None:
    """Acknowledge, shelve or comment an event of a machine.

    EVENT is its id as 'otolith event list' prints it, with or without the time.
    A running daemon takes it over with its next window, the next one otherwise.
    It is shown wherever the event is shown.

    \b
    Examples:
      otolith event list press-3
      otolith event acknowledge press-3 limit/R_a
      otolith event shelve press-3 limit/R_a --for 8h --reason "repair on Friday"
      otolith event comment press-3 limit/R_a "false alarm: another load"
    """


def _text(_: click.Context, parameter: click.Parameter, text: str | None) -> str:
    from otolith.health.notes import MAX_NAME, MAX_NOTE

    limit = MAX_NAME - MAX_ACCOUNT - len(" ()") if parameter.name == "by" else MAX_NOTE
    written = SURROGATE.sub("\ufffd", text or "").strip()
    if len(written) > limit:
        raise click.BadParameter(f"{len(written)} characters: write {limit} at most")
    if text is not None and not written:
        raise click.BadParameter("it is empty: write who or why")
    return written


def _length(_: click.Context, __: click.Parameter, text: str) -> float:
    from otolith.health.notes import MAX_SHELF, MIN_SHELF

    match = re.fullmatch(r"(\d{1,9}(?:\.\d+)?)\s*([smhdw])", text.strip())
    if match is None or not MIN_SHELF <= float(match[1]) * SPANS[match[2]] <= MAX_SHELF:
        bounds = f"{MIN_SHELF:.0f}s to {MAX_SHELF / SPANS['d']:.0f}d"
        raise click.BadParameter(f"{text!r}: write a time of {bounds}, like 30m, 8h or 3d")
    return float(match[1]) * SPANS[match[2]]


BY = click.option("--by", callback=_text, metavar="NAME", help="Who does it.  [default: the user of this computer]")


@event.command("list")
@MACHINE
@AS_JSON
def list_(machine: str, as_json: bool) -> None:
    """List the events that are not cleared, with what persons did.

    \b
    Example:
      otolith event list press-3
    """
    from otolith.health.text import event_lines

    known = _known(machine)
    rows = [known.labels.of_event(item) for item in known.events.values() if item.end is None]
    if as_json:
        echo_json({"events": [item.model_dump(mode="json", exclude_none=True) for item in rows]})
        return
    for item in rows:
        echo(_key(item), *(f"  {line}" for line in event_lines(item)))
    for key in known.shelves.keys() - {_key(item) for item in rows}:
        until = local_time(known.labels.unix(known.shelves[key].note.until or 0.0), known.zone)
        echo(key, f"  no event is open; one that begins is shelved until {until}")
    if not rows:
        echo(f"{known.machine}: no event is open", err=True)


@event.command()
@MACHINE
@EVENT
@click.option("--comment", "text", callback=_text, metavar="TEXT", help="What you think or have done.")
@BY
@AS_JSON
def acknowledge(machine: str, event: str, text: str, by: str, as_json: bool) -> None:
    """State that you have seen EVENT.

    It counts until the event becomes worse or its diagnosis another one.

    \b
    Examples:
      otolith event acknowledge press-3 limit/R_a
      otolith event acknowledge press-3 limit/R_a --comment "maintenance called"
    """
    _do(machine, event, "acknowledge", by, text, as_json=as_json)


@event.command()
@MACHINE
@EVENT
@click.option("--for", "seconds", callback=_length, required=True, metavar="TIME", help="For so long, like 30m or 8h.")
@click.option("--reason", "text", callback=_text, required=True, metavar="TEXT", help="Why.")
@BY
@AS_JSON
def shelve(machine: str, event: str, seconds: float, text: str, by: str, as_json: bool) -> None:
    """Make EVENT silent for a time.

    Neither 'on_event' nor a warning in the log tells of it, also if it ends and
    begins again meanwhile. Its state stays, marked as shelved. It comes back by
    itself, and at once if it becomes worse or its diagnosis another one.

    \b
    Example:
      otolith event shelve press-3 limit/R_a --for 8h --reason "repair on Friday"
    """
    _do(machine, event, "shelve", by, text, seconds, as_json=as_json)


@event.command()
@MACHINE
@EVENT
@BY
@AS_JSON
def unshelve(machine: str, event: str, by: str, as_json: bool) -> None:
    """End the shelving of EVENT now.

    \b
    Example:
      otolith event unshelve press-3 limit/R_a
    """
    _do(machine, event, "unshelve", by, as_json=as_json)


@event.command()
@MACHINE
@EVENT
@click.argument("text", callback=_text)
@BY
@AS_JSON
def comment(machine: str, event: str, text: str, by: str, as_json: bool) -> None:
    """Write TEXT to EVENT, which may be over.

    \b
    Example:
      otolith event comment press-3 limit/R_a "false alarm: another load"
    """
    _do(machine, event, "comment", by, text, as_json=as_json)


@dataclass(frozen=True, slots=True)
class _Known:
    """What is known of the events of a machine."""

    machine: str
    file: "DecisionsFile"
    events: "Mapping[str, EventDocument]"  # The last change of each by its id, the latest first; service times
    labels: "TimeLabels"
    taken: frozenset[str]  # Ids of the notes that the daemon has saved
    shelves: "Mapping[str, Shelf]"  # That it has saved, by what they are about
    zone: str | None  # Of its times


def _known(machine: str) -> _Known:
    """Return the events of a machine, from its history and its saved state; raises as :func:`reader_of`."""
    from otolith.health.labels import TimeLabels
    from otolith.storage.decisions import DecisionsFile

    if machine.endswith(".sqlite"):
        raise click.UsageError(f"{machine} is a copy that no daemon reads: give the machine file, or its name")
    reader = reader_of(machine)
    file = DecisionsFile(reader.path.parents[1] / "components", reader.site, reader.machine)
    learned, has_history = file.learned(), reader.path.is_file()
    events = reader.last_changes() if has_history else {}
    labels = reader.labels() if has_history else TimeLabels()
    if learned is not None:
        events |= {item.id: item for item in learned.health.open_events if item.id not in events}
        labels = learned.clock.labels if not has_history and learned.clock is not None else labels
    taken, shelves = (learned.health.taken, learned.health.shelves) if learned else ((), {})
    zone = reader.language_and_zone()[1] if has_history else next((row.timezone for row in events.values()), None)
    return _Known(reader.machine, file, events, labels, frozenset(taken), shelves, zone)


def _key(item: "EventDocument") -> str:
    """Return what an event is about; of those that are open, one has it."""
    return item.id.rpartition("@")[0]


def _chosen(known: _Known, name: str) -> "EventDocument":
    """Return the event with an id, or of those about it the open one or the latest; raise ConfigurationError."""
    from otolith_drivers.errors import ConfigurationError, nearest

    rows = sorted(known.events.values(), key=lambda item: item.end is not None)  # the latest first among each
    for item in rows:
        if name in (item.id, _key(item)):
            return item
    names = dict.fromkeys(map(_key, rows))
    hint = nearest(name, list(names)) if names else "it has had no event"
    raise ConfigurationError(f"machine {known.machine} has no event {name!r}: {hint}")


def _do(
    machine: str, name: str, deed: str, by: str, text: str = "", seconds: float | None = None, *, as_json: bool
) -> None:
    """Write a note for the daemon, and print it."""
    from otolith.health.notes import Deed, OperatorNote, commented
    from otolith_drivers.errors import ConfigurationError

    known, now = _known(machine), time.time()
    item = _chosen(known, name)
    note = OperatorNote(
        id=uuid.uuid4().hex, deed=Deed(deed), event=item.id, by=_person(by), at=now, text=text, seconds=seconds
    )
    waiting = (each for each in known.file.read().notes if each.deed is Deed.SHELVE and each.event == item.id)
    is_shelved = item.shelved is not None or _key(item) in known.shelves or any(waiting)
    if note.deed is Deed.UNSHELVE and not is_shelved:
        raise ConfigurationError(f"event {item.id} is not shelved: 'otolith event list' shows what is")
    if item.end is not None and note.deed in (Deed.ACKNOWLEDGE, Deed.SHELVE):
        end = local_time(known.labels.unix(item.end), known.zone)
        raise ConfigurationError(f"event {item.id} ended at {end}: only 'otolith event comment' is possible")

    def noted(waiting: "Sequence[OperatorNote]") -> "OperatorNote":
        if item.end is None or note.deed is not Deed.COMMENT:
            return note
        last = next((each.ended for each in reversed(waiting) if each.event == item.id and each.ended), item)
        own = note.at_time(known.labels.last(now)).document
        return note.model_copy(update={"ended": commented(last, own)})

    known.file.note(noted, known.taken)
    _print(known, known.labels.of_event(item), note, as_json=as_json)


def _print(known: _Known, item: "EventDocument", note: "OperatorNote", *, as_json: bool) -> None:
    is_running, document = known.file.is_obeyed(), note.document
    if as_json:
        rest: dict[str, Any] = document.model_dump(exclude_none=True)
        echo_json({"event": item.id, "deed": note.deed, **rest, "daemon": is_running})
    else:
        until = "" if document.until is None else f" until {local_time(document.until, known.zone)}"
        echo(f"{DONE[note.deed]}{until} by {note.by}: {item.part}: {item.condition}")
    if not is_running:
        remedy = "start it with 'otolith run', or with systemctl if it is installed"
        echo(f"no daemon runs for {known.machine}: the next one takes it over; {remedy}", err=True)


DONE: Mapping[str, str] = {
    "acknowledge": "acknowledged",
    "shelve": "shelved",
    "unshelve": "unshelved",
    "comment": "commented",
}


def _person(name: str) -> str:
    """Return the account that runs this command, behind the ``name`` that was given."""
    account = ((os.environ.get("SUDO_USER", "") if os.geteuid() == 0 else "") or _login())[:MAX_ACCOUNT]
    return SURROGATE.sub("\ufffd", f"{name} ({account})" if name else account)


def _login() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return f"user {os.geteuid()}"
