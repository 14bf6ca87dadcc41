"""Any text of a file, a device, a server, a message or a certificate leaves a writer only escaped, or is refused.

Each writer has a row: what writes a text, and what must hold of what it wrote.
"""

import csv
import io
import json
import logging
import re
import tomllib
from collections.abc import Callable
from typing import Any, NamedTuple

import click
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
from otolith.cli.terminal import JournalFormatter, LogFormatter, echo, echo_csv, echo_json
from otolith.health.schema import DriverDocument, EventChange, ReportDocument
from otolith.storage.evidence import public_text
from otolith_drivers.grammars.json_lines import checked_line
from otolith_drivers.grammars.toml_lines import toml_comment, toml_key, toml_value
from otolith_drivers.opcua.connection import Variable
from otolith_drivers.outside_text import CONTROL
from tests.hostile import HOSTILE, hostile_text
from tests.storage.histories import document

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

WRITERS = {
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


@pytest.mark.parametrize("name", WRITERS)
def test_each_attack_is_escaped(name: str) -> None:
    for text in HOSTILE:
        WRITERS[name].check(text, WRITERS[name].write(text))
