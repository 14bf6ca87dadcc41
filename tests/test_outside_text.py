"""Any text of a file, a device, a server, a message or a certificate leaves a writer only escaped, or is refused.

Each writer has a row: what writes a text, and what must hold of what it wrote.
"""

import csv
import io
import json
import logging
import re
import socket
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from pydantic import BaseModel
from rich.live import Live
from rich.table import Table
from rich.text import Text

from otolith.cli.commissioning.probe import _opcua_line
from otolith.cli.console import Terminal
from otolith.cli.operation.live_table import LiveTable
from otolith.cli.operation.unit_file import comment, directive
from otolith.cli.terminal import JournalFormatter, LogFormatter, echo, echo_csv, echo_json
from otolith.health.labels import TimeLabels
from otolith.health.schema import DriverDocument, EventChange, EventDocument, ReportDocument
from otolith.machine_file import MachineTable
from otolith.publishing.html_report import html_report
from otolith.publishing.recorder import LOG, _columns, operator_text, report_text
from otolith.publishing.zenoh_session import prefix
from otolith.runtime.hall.notifier import Notifier
from otolith.runtime.process import EventCommand
from otolith.storage.evidence import public_text
from otolith.storage.history import WINDOW, path_in
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.grammars.json_lines import checked_line, json_text
from otolith_drivers.grammars.toml_lines import toml_comment, toml_key, toml_value
from otolith_drivers.opcua.connection import Variable
from otolith_drivers.outside_text import CONTROL
from tests.hostile import HOSTILE, hostile_text
from tests.publishing.test_html_report import written
from tests.storage.histories import START, document
from tests.waiting import wait_for

COLOUR = re.compile(r"\x1b\[[0-9;]*m|\x1b\[\?25[lh]|\x1b\[\d*[AK]")
"""The escape sequences of our own: colours, and those that draw a table again in its place."""


class Writer(NamedTuple):
    """A place where text leaves the program."""

    write: Callable[[str], str]
    check: Callable[[str, str], object]  # of the text and of what was written of it


def whole(text: str) -> str:
    """What is left of a text in a file in UTF-8, which has no halves of a pair."""
    return "".join("\ufffd" if "\ud800" <= character <= "\udfff" else character for character in text)


def assert_lines(written: str, count: int | None = None) -> None:
    """Assert that all of ``written`` can be encoded and is so many lines without a control."""
    written.encode()
    lines = written.removesuffix("\n").split("\n")
    assert not any(CONTROL.search(line) for line in lines)
    assert count is None or len(lines) == count


def with_text(model: BaseModel, text: str) -> Any:
    """The document with ``text`` in each field, tuple and key that may hold any text."""
    changed: dict[str, Any] = {}
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if field.annotation is str or field.annotation == str | None:
            changed[name] = text
        elif field.annotation == tuple[str, ...]:
            changed[name] = (text, text)
        elif isinstance(value, BaseModel):
            changed[name] = with_text(value, text)
        elif isinstance(value, tuple):
            changed[name] = tuple(with_text(item, text) if isinstance(item, BaseModel) else item for item in value)
        elif isinstance(value, dict):
            items = (with_text(item, text) if isinstance(item, BaseModel) else item for item in value.values())
            changed[name] = dict(zip([text], items, strict=False))
    return model.model_copy(update=changed)


def report_with(text: str) -> ReportDocument:
    """A report of a machine whose driver is down, with an event and a finding."""
    made = document(51, 1_700_000_000.0, change=EventChange.RAISED)
    report = made.model_copy(update={"driver": DriverDocument(up=False), "notes": ("",)})
    changed: ReportDocument = with_text(report, text)
    return changed


def printed(run: Callable[[], object]) -> str:
    """What a command prints to both streams."""

    @click.command()
    def command() -> None:
        run()

    result = CliRunner().invoke(command, catch_exceptions=False)
    return result.output


def is_toml_of(expected: Any) -> Callable[[str, str], None]:
    def check(text: str, written: str) -> None:
        assert_lines(written)
        assert tomllib.loads(written) == expected(whole(text))

    return check


def opcua_line(text: str) -> str:
    variable = Variable(node=f"ns=2;s={text}", path=f"Motor/{text}", value=text, type=text, unit=text, status=text)
    return "[signals]\n" + _opcua_line(variable)


def only_the_node(text: str, written: str) -> None:
    assert_lines(written, 2)
    (signal,) = tomllib.loads(written)["signals"].values()
    assert signal == {"node": f"ns=2;s={whole(text)}"} | ({} if text else {"unit": "?"})


TOML = {
    "key": Writer(lambda text: f"{toml_key(text)} = 1", is_toml_of(lambda text: {text: 1})),
    "value": Writer(
        lambda text: f"a = {toml_value([text, {text: text}, True, 1.5])}",
        is_toml_of(lambda text: {"a": [text, {text: text}, True, 1.5]}),
    ),
    "comment": Writer(lambda text: f"a = 1  {toml_comment(text)}", is_toml_of(lambda _: {"a": 1})),
    "line of a variable": Writer(opcua_line, only_the_node),
    "machine file of a bundle": Writer(
        lambda text: public_text({"limits": {text: text}, "rule": [{"a": text}]}),
        is_toml_of(lambda text: {"limits": {text: text}, "rule": [{"a": text}]}),
    ),
}


def drawn(*shown: Any, live: bool = False) -> str:
    """What a terminal with colours receives."""
    stream = io.StringIO()
    console = Terminal(file=stream, force_terminal=True, width=100, highlight=True, color_system="standard")
    if live:
        with Live(shown[0], console=console, auto_refresh=False):
            pass
    else:
        console.print(*shown, soft_wrap=True)
    return stream.getvalue()


def table_of(text: str) -> Table:
    table = Table(text, title=text)
    table.add_row(text)
    table.add_row(Text(text, style="bold red"))
    return table


def live_table_of(text: str) -> LiveTable:
    table = LiveTable(lambda: text)
    assert table.add(report_with(text).to_json())
    return table


def has_only_own_colours(_: str, written: str) -> None:
    assert_lines(COLOUR.sub("", written).replace("\r", ""))


def logged(text: str, formatter: logging.Formatter) -> str:
    error = ValueError(text)
    return formatter.format(
        logging.LogRecord("otolith", logging.WARNING, __file__, 1, "a %s", (text,), (ValueError, error, None))
    )


def are_lines_of_the_journal(_: str, written: str) -> None:
    assert_lines(written)
    lines = written.split("\n")
    assert all(line.startswith("<4>") for line in lines)
    assert lines[1].startswith("<4>ValueError")


TERMINAL = {
    "line": Writer(lambda text: printed(lambda: echo(text)), lambda _, written: assert_lines(written, 1)),
    "error": Writer(lambda text: printed(lambda: echo(text, err=True)), lambda _, written: assert_lines(written, 1)),
    "styled text": Writer(lambda text: drawn(Text(text, style="bold red")), has_only_own_colours),
    "text": Writer(drawn, lambda _, written: assert_lines(COLOUR.sub("", written), 1)),
    "table": Writer(lambda text: drawn(table_of(text)), has_only_own_colours),
    "table of reports": Writer(lambda text: drawn(live_table_of(text), live=True), has_only_own_colours),
    "log": Writer(lambda text: logged(text, LogFormatter()), lambda _, written: assert_lines(written)),
    "journal": Writer(lambda text: logged(text, JournalFormatter("%(message)s")), are_lines_of_the_journal),
}


def is_json_of(expected: Callable[[str], Any]) -> Callable[[str, str], None]:
    def check(text: str, written: str) -> None:
        assert_lines(written, 1)
        assert json.loads(written, parse_constant=pytest.fail) == expected(text)

    return check


def is_the_report(text: str, written: str) -> None:
    assert_lines(written, 1)
    assert ReportDocument.from_json(written) == report_with(whole(text))


def forwarded(text: str) -> str:
    text = whole(text)
    return checked_line(json.dumps({text: [text]}, ensure_ascii=False, indent=1).replace("\n", "\r\n"))


JSON = {
    "document": Writer(
        lambda text: printed(lambda: echo_json({text: [text, 1.5, float("nan")]})),
        is_json_of(lambda text: {whole(text): [whole(text), 1.5, None]}),
    ),
    "report": Writer(lambda text: report_with(text).to_json(), is_the_report),
    "report of another program": Writer(forwarded, is_json_of(lambda text: {whole(text): [whole(text)]})),
}


def is_a_cell(_: str, written: str) -> None:
    assert_lines(written, 1)
    ((cell, number),) = csv.reader(io.StringIO(written, newline=""))
    assert not cell.startswith(("=", "+", "-", "@"))
    assert number == "-1.5"


TABLES = {"CSV": Writer(lambda text: printed(lambda: echo_csv([[text, -1.5]])), is_a_cell)}


class Tags(HTMLParser):
    """The tags of a page, with the names of their attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: set[tuple[str, ...]] = set()
        self.feed(page)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found.add((tag, *sorted(name for name, _ in attributes)))


def is_a_page(text: str, written: str) -> None:
    assert_lines(written)
    assert Tags(written).found <= Tags(page_of("x")).found | Tags(page_of("")).found


def page_of(text: str) -> str:
    report = report_with(text).model_copy(update={"machine": "press-3", "site": "hall-1"})
    values = {text: [1.0, text, text]}
    description = {"title": text, "equations": [[text, text]], "values": values, "limits": {}, "sites": {}}
    reader = written([report], description=json_text(description))
    return html_report(reader, reader.samples(WINDOW, START), "window", START, START + 60.0)


def kept(text: str) -> str:
    """What the history gives back of a report."""
    report = report_with(text).model_copy(update={"machine": "press-3", "site": "hall-1"})
    return str(written([report]).latest(1)[0].to_json())


def is_kept(text: str, written: str) -> None:
    read, expected = ReportDocument.from_json(written), report_with(whole(text))
    assert (read.driver, read.notes, read.twin) == (expected.driver, expected.notes, expected.twin)


def resent(text: str) -> str:
    """What the history answers about an event after the clock was set."""
    report = report_with(text).model_copy(update={"machine": "press-3", "site": "hall-1"})
    return written([report], labels=TimeLabels(((START - 100.0, 3600.0),))).messages("event", 1000)[-1]


def is_the_message(text: str, message: str) -> None:
    assert_lines(message, 1)
    assert EventDocument.model_validate_json(message).text == report_with(whole(text)).events[0].text


def sent_to_a_command(text: str) -> str:
    """What ``on_event`` gets on its standard input."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "event"
        script = f"cat > {target}.new && mv {target}.new {target}"
        command = EventCommand(["/bin/sh", "-c", script], "m", "s")
        command.run(report_with(text).events[0])
        wait_for(target.exists)
        command.stop(5.0)
        return target.read_text(encoding="utf-8")


def is_the_event(text: str, written: str) -> None:
    assert_lines(written, 1)
    assert EventDocument.model_validate(json.loads(written)["event"]) == report_with(whole(text)).events[0]


def told_to_systemd(text: str) -> str:
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"{folder}/notify")
        notifier = Notifier({"NOTIFY_SOCKET": f"{folder}/notify"})
        notifier.send("READY=1", f"STATUS=listening: {text}")
        notifier.close()
        return manager.recv(1 << 20).decode()


def are_two_assignments(_: str, written: str) -> None:
    assert_lines(written, 2)
    assert written.startswith("READY=1\nSTATUS=listening: ")


def is_markdown_like(write: Callable[[str], str]) -> Callable[[str, str], None]:
    """The text has the same lines and cells as a harmless one."""

    def shape(markdown: str) -> list[int]:
        return [len(re.findall(r"(?<!\\)(?:\\\\)*\|", line)) for line in markdown.split("\n")]

    def check(text: str, written: str) -> None:
        assert_lines(written)
        assert not text or shape(written) == shape(write("x"))

    return check


def marked(write: Callable[[ReportDocument], str]) -> Writer:
    def of(text: str) -> str:
        return write(report_with(text).model_copy(update={"machine": "press-3", "site": "hall-1"}))

    return Writer(of, is_markdown_like(of))


def logged_by_the_recorder(text: str) -> str:
    (shown, _) = _columns(LOG, [(np.array(0), (text, "WARN"))])
    return str(shown.as_arrow_array()[0].as_py()[0])


DOCUMENTS = {
    "HTML": Writer(page_of, is_a_page),
    "history": Writer(kept, is_kept),
    "history: event": Writer(resent, is_the_message),
    "command": Writer(sent_to_a_command, is_the_event),
    "systemd": Writer(told_to_systemd, are_two_assignments),
    "recording: state": marked(operator_text),
    "recording: report": marked(report_text),
    "recording: log": Writer(logged_by_the_recorder, lambda _, written: assert_lines(written, 1)),
}
"""Writers that take some milliseconds."""
BOUNDED, MOST = {"HTML", "history", "history: event"}, 1 << 14
"""Writers behind the guard of drivers, which cuts their texts; the database has a size; and so many characters."""


def refused_or(write: Callable[[str], str]) -> Callable[[str], str]:
    def written_or_nothing(text: str) -> str:
        try:
            return write(text)
        except (ConfigurationError, ValueError):
            return ""

    return written_or_nothing


def is_one_name(_: str, written: str) -> None:
    assert not written or re.fullmatch(r"[A-Za-z0-9_./-]+", written)
    assert written.count("/") in (0, 2)  # of a key of Zenoh: otolith/SITE/MACHINE
    assert ".." not in written


def machine_of(text: str) -> tuple[str, str]:
    table = MachineTable.model_validate({"name": text, "site": text})
    return table.site, table.name


def is_a_line_of_a_unit(text: str, written: str) -> None:
    assert not written or written == f"DeviceAllow={text}"
    assert_lines(written, 1)


NAMES = {
    "key of Zenoh": Writer(refused_or(lambda text: prefix(*machine_of(text))), is_one_name),
    "file name": Writer(refused_or(lambda text: path_in(Path(), *machine_of(text)).name), is_one_name),
    "unit": Writer(refused_or(lambda text: directive("DeviceAllow", text)), is_a_line_of_a_unit),
    "comment of a unit": Writer(comment, lambda _, written: assert_lines(written, 1)),
}

WRITERS = {
    **NAMES,
    **{f"TOML: {name}": writer for name, writer in TOML.items()},
    **{f"terminal: {name}": writer for name, writer in TERMINAL.items()},
    **{f"JSON: {name}": writer for name, writer in JSON.items()},
    **TABLES,
}


@pytest.mark.parametrize("name", WRITERS)
@given(text=hostile_text)
@settings(max_examples=40, deadline=None)
def test_any_text_is_escaped(name: str, text: str) -> None:
    WRITERS[name].check(text, WRITERS[name].write(text))


@pytest.mark.parametrize("name", [*WRITERS, *DOCUMENTS])
def test_each_attack_is_escaped(name: str) -> None:
    writer = {**WRITERS, **DOCUMENTS}[name]
    for text in HOSTILE:
        some = text[:MOST] if name in BOUNDED else text
        writer.check(some, writer.write(some))


def test_a_log_line_of_a_command_without_a_log_is_escaped() -> None:
    """Libraries warn with what a device has sent, and most commands set up no log."""
    warn = "logging.getLogger('library').warning('from a device: \\x1b[2J\\nnone')"
    code = f"import atexit, logging; from otolith.__main__ import main; atexit.register(lambda: {warn}); main()"
    done = subprocess.run([sys.executable, "-c", code, "--version"], capture_output=True, text=True, check=True)
    assert_lines(done.stderr, 1)
    assert "from a device" in done.stderr
