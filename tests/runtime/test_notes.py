"""What a person does with an event reaches the daemon, survives restarts and wrong clocks, and is shown everywhere."""

import io
import json
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
from click.testing import Result

from otolith.cli.console import Terminal
from otolith.cli.operation import event as command
from otolith.cli.operation.live_table import state_lines
from otolith.health.notes import MAX_NOTE
from otolith.health.schema import EventChange, EventDocument
from otolith.publishing.recorder import operator_text
from otolith_drivers.errors import ConfigurationError
from tests.cli.commands import otolith
from tests.messages import assert_says, raises_saying
from tests.runtime.test_clock import DAY, HEALTHY, HOUR, LENGTH, NOW, Computer, Daemons, daemons
from tests.variants import often

__all__ = ["daemons"]
RAISED = HEALTHY + 4  # windows after which the event is open
HOSTILE = "false alarm <blink>\x1b[2J\u202e"
SHELF = 3.5 * LENGTH  # s


class Person:
    """Who gives commands on the computer of a daemon, and waits until it obeys."""

    def __init__(self, running: Daemons, monkeypatch: pytest.MonkeyPatch) -> None:
        self.running = running
        monkeypatch.setattr(command, "time", SimpleNamespace(time=lambda: running.computer.read().unix))

    def does(self, deed: str, *arguments: str) -> Result:
        """Give a command about the event, which the daemon obeys before its next window."""
        result = self.asks(deed, "limit/R_a", *arguments)
        self.obeyed()
        return result

    def asks(self, deed: str, *arguments: str) -> Result:
        return otolith("event", deed, self.running.machine.path, *arguments)

    def obeyed(self) -> None:
        machine, store = self.running.service.machine, self.running.service._store
        machine.state = self.running.service._decided(machine.state, store.decisions())

    @property
    def event(self) -> EventDocument:
        """The event as it was published last."""
        return next(item for item in self.running.published[-1].events if item.id.startswith("limit/R_a"))

    def changes(self) -> list[EventChange | None]:
        """All changes of the event, as the history has them."""
        self.written()
        return [item.change for item in self.running.reader.events(0.0) if item.id.startswith("limit/R_a")]

    def written(self) -> None:
        history = self.running.service._history
        assert history is not None
        history._wakeup.set()
        assert history._written.wait(10.0)


Begin = Callable[[Computer], Person]


@pytest.fixture
def begin(daemons: Callable[[Computer], Daemons], monkeypatch: pytest.MonkeyPatch) -> Iterator[Begin]:
    """Function that starts a daemon, waits until an event is open, and returns who is there."""
    started: list[Daemons] = []

    def begun(computer: Computer) -> Person:
        started.append(daemons(computer))
        started[-1].run(RAISED)
        person = Person(started[-1], monkeypatch)
        person.written()
        return person

    yield begun
    for running in started:
        running.stop()


def test_it_is_shown_everywhere_and_survives_a_restart(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    person = begin(Computer())
    said = person.does("acknowledge")
    assert_says(said.output, "acknowledged", "winding")
    person.running.run(1)
    person.does("comment", HOSTILE, "--by", "A. Kern")
    person.running.run(1)
    person.does("shelve", "--for", "2h", "--reason", "motor comes on Friday")
    person.running.run(1)
    person.running.restart()
    person.running.run(1)
    event, health = person.event, person.running.published[-1].health
    assert health is not None
    assert event.acknowledged is not None
    assert event.shelved is not None
    assert event.shelved.until == pytest.approx(event.shelved.at + 2.0 * HOUR)
    assert event.shelved.at == pytest.approx(person.running.computer.read().unix, abs=5.0 * LENGTH)
    assert health.shelved == event.shelved.until
    (comment,) = event.comments or ()
    assert (comment.text, comment.by.startswith("A. Kern (")) == (HOSTILE, True)
    acts = [EventChange.RAISED, EventChange.ACKNOWLEDGED, EventChange.COMMENTED, EventChange.SHELVED]
    assert person.changes() == acts  # none of them again after the restart
    table = io.StringIO()
    console = Terminal(file=table, width=400)
    console.print(*state_lines(person.running.published[-1]), sep="\n")
    shown = {
        "watch": table.getvalue(),
        "history": otolith("history", person.running.machine.path, "--since", "9000d", "--events").output,
        "list": person.asks("list").output,
        "recording": operator_text(person.running.published[-1]).replace("\\", ""),
        "page": otolith("report", person.running.machine.path, "--since", "9000d", "--output", "-").output,
    }
    for name, text in shown.items():
        assert "\x1b" not in text, name
        assert "\u202e" not in text, name
        assert ("<blink>" in text) == (name != "page")
        assert_says(text, "shelved until", "motor comes on Friday", "acknowledged", "A. Kern", "false alarm")
    listed = json.loads(person.asks("list", "--json").output)["events"]
    assert [item["comments"][0]["text"] for item in listed] == [HOSTILE]


CLOCKS = {
    "right": (0.0, 0.0),
    "boots in 1970, then right": (-NOW, 0.0),
    "an hour back": (0.0, -HOUR),
    "an hour ahead": (0.0, HOUR),
    "a year ahead": (0.0, 365 * DAY),
}


@pytest.mark.parametrize("name", often(("boots in 1970, then right", "an hour ahead"), CLOCKS))
def test_a_shelf_ends_after_its_time_whatever_the_clock_does(name: str, begin: Begin) -> None:
    first, then = CLOCKS[name]
    person = begin(Computer(error=first))
    person.does("shelve", "--for", f"{SHELF:.0f}s", "--reason", "a spare part")
    person.running.run(2)
    person.running.computer.error = then
    person.running.run(1)
    assert person.event.shelved is not None
    person.running.run(1)
    assert person.event.shelved is None
    assert person.event.change is EventChange.UNSHELVED


@pytest.mark.parametrize("away", [20.0, 1000.0])
def test_a_shelf_goes_on_while_the_computer_is_off(away: float, begin: Begin) -> None:
    person = begin(Computer())
    person.does("shelve", "--for", "300s", "--reason", "a spare part")
    person.running.run(1)
    person.running.stop()
    person.running.computer.reboot(away)
    person.running.service = person.running._started()
    person.running.run(1)
    assert (person.event.shelved is None) == (away > 300.0)


def test_without_a_daemon_the_next_one_takes_it_over(begin: Begin) -> None:
    person = begin(Computer())
    running = person.running
    running.stop()
    said = person.asks("acknowledge", "limit/R_a", "--json")
    assert json.loads(said.stdout)["daemon"] is False
    assert_says(said.stderr, "otolith run")
    person.asks("shelve", "limit/R_a", "--for", "60s", "--reason", "short")
    running.computer.time += 120.0
    running.service = running._started()
    running.run(1)
    assert person.event.acknowledged is not None
    assert person.event.shelved is None  # its time was over
    running.restart()
    running.run(1)
    assert person.event.acknowledged is not None
    assert person.changes().count(EventChange.ACKNOWLEDGED) == 1


def test_what_the_daemon_has_taken_over_leaves_the_file(begin: Begin) -> None:
    person = begin(Computer())
    for number in range(3):
        person.does("comment", f"number {number}")
        person.running.run(1)
        person.running.service._store.save(person.running.service.machine.state)
    assert [note.text for note in person.running.service._store.decisions().notes] == ["number 2"]
    assert [note.text for note in person.event.comments or ()] == ["number 0", "number 1", "number 2"]


def test_an_event_that_is_over_takes_comments_only(begin: Begin) -> None:
    person = begin(Computer())
    person.running.run(9)
    assert person.changes()[-1] is EventChange.CLEARED
    with raises_saying(ConfigurationError, "limit/R_a@", "ended", "comment"):
        person.asks("shelve", "limit/R_a", "--for", "1h", "--reason", "late")
    for text in ("it was the test bench", "and is gone"):
        person.asks("comment", "limit/R_a", text)
    person.obeyed()
    person.running.run(1)
    last = next(item for item in person.running.published[-1].events if item.change is EventChange.COMMENTED)
    assert [note.text for note in last.comments or ()] == ["it was the test bench", "and is gone"]
    assert person.changes()[-1] is EventChange.COMMENTED


def test_a_wrong_argument_is_named(begin: Begin) -> None:
    person = begin(Computer())
    with raises_saying(ConfigurationError, "limit/R_b", "limit/R_a"):
        person.asks("acknowledge", "limit/R_b")
    with raises_saying(ConfigurationError, "limit/R_a@", "not shelved"):
        person.asks("unshelve", "limit/R_a")
    for arguments, parts in (
        (("shelve", "limit/R_a", "--for", "8d", "--reason", "x"), ("8d", "1s", "7d")),
        (("shelve", "limit/R_a", "--for", "0.0000001s", "--reason", "x"), ("0.0000001s", "1s", "7d")),
        (("shelve", "limit/R_a", "--for", "1h", "--reason", " "), ("empty",)),
        (("comment", "limit/R_a", "x" * (MAX_NOTE + 1)), (f"{MAX_NOTE + 1}", f"{MAX_NOTE}")),
    ):
        with raises_saying(Exception, *parts):
            person.asks(*arguments)
    assert person.running.service._store.decisions().notes == ()
