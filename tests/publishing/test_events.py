"""An event is published and logged once, when it changes, and shown as long as it is not cleared."""

import logging
import re
import socket
import time

import pytest
from rich.console import Console

from otolith.cli.operation.live_table import BARS, LEVEL_STYLES, LiveTable, event_style, sparkline
from otolith.health.limits import Level
from otolith.health.schema import EventChange, EventDocument, ParameterDocument, ReportDocument, Status
from otolith.health.text import value_cells
from otolith.health.times import moment_text
from otolith.machine import load_machine
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.recorder import _log_lines
from otolith.publishing.zenoh_session import EVENT, session
from otolith.runtime.service import SUMMARY_INTERVAL, Service
from tests.conftest import EXAMPLES, free_port
from tests.health.test_events import assessed, report
from tests.waiting import wait_for

CHANGES = [EventChange.RAISED, EventChange.CHANGED, EventChange.CLEARED]


def documents() -> list[ReportDocument]:
    """The winding at WATCH, at ACT, and back."""
    values = [*[6.5] * 3, *[6.2] * 6, *[5.8] * 6, *[6.5] * 6]
    return assessed(report(index, value) for index, value in enumerate(values))


def test_each_change_of_an_event_is_published_once() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    publisher = Publisher([Published("s", "m")], [endpoint])
    received: list[tuple[str, str]] = []

    def published(document: ReportDocument, count: int) -> bool:
        publisher.publish(document)
        return len(received) > count

    def events() -> list[EventDocument]:
        key = EVENT.under("s", "m")
        return [EventDocument.model_validate_json(text) for own, text in received if own == key]

    with session(connect=[endpoint]) as listener:
        listener.declare_subscriber(
            "otolith/**", lambda sample: received.append((str(sample.key_expr), sample.payload.to_string()))
        )
        wait_for(lambda: published(documents()[0], 0))  # it has no event
        for document in documents():
            publisher.publish(document)
        wait_for(lambda: len(events()) >= len(CHANGES))
        publisher.close()
    assert [event.change for event in events()] == CHANGES
    assert len({event.id for event in events()}) == 1


def test_events_are_logged_once_at_their_priority(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: False)
    service = Service(load_machine(EXAMPLES / "dc-motor-in-process.toml"))
    with caplog.at_level(logging.DEBUG, "otolith"):
        for index, document in enumerate(documents()):
            service._log(document, 0.1 * SUMMARY_INTERVAL * index)
    levels = [record.levelname for record in caplog.records if record.levelno > logging.INFO]
    assert levels == ["WARNING", "ERROR", "WARNING"]
    assert [record.levelname for record in caplog.records].count("INFO") == 3


def test_the_recording_has_an_event_on_its_changes_only() -> None:
    lines = [(text.partition(":")[0], level) for document in documents() for text, level in _log_lines(document)]
    assert lines == [("WATCH", "WARN"), ("ACT", "ERROR"), ("cleared", "WARN")]


def drawn(*shown: ReportDocument, width: int = 200) -> str:
    table, console = LiveTable(lambda: "waiting"), Console(width=width)
    for document in shown:
        table.add(document.to_json())
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_the_live_table_begins_with_the_state() -> None:
    at_act = next(document for document in documents() if document.health and document.health.state is Level.ACT)
    lines = drawn(at_act).splitlines()
    assert lines[0].startswith("ACT since ")
    assert "winding: short circuit between turns of the winding" in lines[0]
    assert lines[1].split()[:2] == ["winding", "ACT"]
    assert "plan a replacement of the winding" in " ".join(drawn(at_act).split())
    assert drawn(documents()[0]).startswith("OK since ")


def test_a_cleared_event_has_the_style_of_what_is_well() -> None:
    levels = {None: Level.ACT, EventChange.CLEARED: Level.OK}
    events = [event for document in documents()[12:] for event in document.events if event.change in levels]
    assert {event.change for event in events} == set(levels)
    assert all(event_style(event) == LEVEL_STYLES[levels[event.change]] for event in events)


def test_the_curve_is_scaled_to_the_limits() -> None:
    """Noise of a healthy machine is no mountain, and a value at ACT is at the edge."""
    scale = (6.175, 6.825)
    assert sparkline((6.5, 6.5001, 6.4999), scale) == BARS[4] + BARS[4] + BARS[3]
    assert sparkline((6.8, 6.174, 5.0), scale) == BARS[7] + BARS[0] + BARS[0]
    healthy = documents()[0].parameters["R_a"]
    assert healthy.limit == pytest.approx(6.0)
    assert drawn(documents()[0]).count(BARS[4]) == 1


@pytest.mark.parametrize("width", [40, 60, 70, 75, 80])
def test_a_narrow_terminal_splits_no_word(width: int) -> None:
    document = next(document for document in documents() if document.health and document.health.state is Level.ACT)
    words = drawn(document, width=width).split()
    assert {"estimated", "resistance", "winding:"} <= set(words)
    assert {*value_cells(document.parameters["R_a"])[:3]} <= set(words)


def test_each_machine_has_its_own_table_and_curves() -> None:
    first, second = documents()[0], documents()[0].model_copy(update={"machine": "press-9"})
    text = drawn(second, first, second)
    blocks = [block for block in text.split("\n\n") if "R_a" in block]
    assert [block.split()[0] for block in blocks] == [first.machine, "press-9"]
    assert [block.count(BARS[4]) for block in blocks] == [1, 2]  # a point per report of that machine
    assert "otolith watch MACHINE" in text
    assert "otolith watch MACHINE" not in drawn(first)


@pytest.mark.parametrize("width", [40, 60, 70, 80])
def test_a_narrow_terminal_cuts_no_number(width: int) -> None:
    document = documents()[0]
    wide = ParameterDocument(
        value=1.23456e9, sd=1.25e7, unit="Pa*s^2/m^6", nominal=6e8, status=Status.UNESTIMATED
    )  # the longest cells
    text = drawn(document.model_copy(update={"parameters": {"h_2": wide}}), width=width)
    assert "…" not in text
    assert all(cell in text for cell in ("h_2", *value_cells(wide)))


@pytest.mark.parametrize("width", [60, 80])
def test_a_silent_machine_is_grey_and_dated_beside_a_running_one(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    at_act = next(document for document in documents() if document.health and document.health.state is Level.ACT)
    running = at_act.model_copy(update={"machine": "z-runs"})
    table, console = LiveTable(lambda: "connected"), Console(width=width, force_terminal=True, color_system="standard")
    table.add(at_act.to_json())
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 4000.0)
    table.add(running.to_json())
    with console.capture() as capture:
        console.print(table)
    silent, whole = capture.get().split("\x1b[1mz-runs")
    text = re.sub(r"\x1b\[[\d;]*m", "", silent)
    assert f"no report since {moment_text(at_act.window.end)} (67 min): connected" in " ".join(text.split())
    value, half, *_ = value_cells(at_act.parameters["R_a"])
    assert value in text
    assert half in text
    assert set(re.findall(r"\x1b\[([\d;]*)m", silent.partition("connected")[2])) == {"0", "2"}
    assert "\x1b[1;31mACT" in whole
