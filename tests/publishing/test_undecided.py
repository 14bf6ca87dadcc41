"""While a cause is not yet known, each screen says what is new and what to do; none says that all is well."""

import io
import re
from pathlib import Path

import pytest

from otolith.cli.console import Terminal
from otolith.cli.operation.live_table import LiveTable
from otolith.health.limits import Level
from otolith.health.schema import (
    FindingDocument,
    FindingKind,
    HealthDocument,
    Language,
    PartDocument,
    ReportDocument,
    Severity,
)
from otolith.health.text import texts_in
from otolith.publishing.html_report import html_report
from otolith.publishing.recorder import operator_text
from otolith.storage.history import WINDOW
from otolith.storage.history_writer import Bounds, HistoryWriter, Numbers
from tests.storage.histories import START, document


def undecided(language: Language) -> ReportDocument:
    """A report of a machine that is well, but for something new."""
    part = PartDocument(state=Level.OK, since=START)
    finding = FindingDocument(
        id="open", kind=FindingKind.OPEN, severity=Severity.WARNING, condition="something new", text="formulas",
        since=START,
    )  # fmt: skip
    health = HealthDocument(**part.model_dump(), parts={"winding": part}, language=language)
    return document(7, START + 14.0).model_copy(update={"health": health, "findings": (finding,)})


def shown(report: ReportDocument, folder: Path) -> dict[str, str]:
    table, console = LiveTable(lambda: ""), Terminal(file=io.StringIO(), width=200)
    table.add(report.to_json())
    console.print(table)
    writer = HistoryWriter(folder / "hall-1.press-3.history.sqlite", Bounds(20_000_000, 3650, 24))
    writer.open(START)
    writer.add(Numbers(START).number(report))
    writer._write_waiting()
    writer._close()
    reader = writer.reader
    page = html_report(reader, reader.samples(WINDOW, 0.0), "window", START, report.window.end)
    texts = {
        "watch": console.file.getvalue(),  # type: ignore[attr-defined]
        "page": re.sub(r"<[^>]*>", "", page),
        "recording": operator_text(report),
    }
    return {name: " ".join(text.split()) for name, text in texts.items()}


@pytest.mark.parametrize("language", ["en", "de"])
def test_every_screen_says_what_to_do(language: Language, tmp_path: Path) -> None:
    say = texts_in(language)
    for name, text in shown(undecided(language), tmp_path).items():
        assert f"{say('what_to_do')}: {say('undecided_advice')}" in text, name
        assert text.count(say("what_to_do")) == 1, name
        assert "something new" in text, name
        assert say("all_well") not in text, name
