"""Where people read German, numbers have a decimal comma, on every screen; machines get points in each language."""

import io
import re
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from otolith.cli.console import Terminal
from otolith.cli.main import cli
from otolith.cli.operation.live_table import LiveTable
from otolith.health.labels import Numbers
from otolith.health.limits import Level
from otolith.health.schema import EventChange, HealthDocument, PartDocument, ReportDocument
from otolith.health.text import event_text, texts_in
from otolith.publishing.recorder import operator_text, report_text
from otolith.storage.history import history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from tests.storage.histories import MACHINE, SITE, document

POINT = re.compile(r"(?<![\w.,:])\d+\.\d+(?![\d.:])")
TEXT = "Ankerwiderstand R_a ist 6.100 ± 0.020 Ω (-6.15 %), erreicht HANDELN in 3.1 h bis 4.9 h"


def german(now: float) -> ReportDocument:
    """A report of a machine with an open event."""
    own = document(7, now, 6.1, change=EventChange.RAISED)
    (event,) = own.events
    event = event.model_copy(update={"text": TEXT, "condition": "Kurzschluss", "language": "de", "since": now - 5.0})
    part = PartDocument(state=Level.WATCH, since=now - 5.0, reason="Kurzschluss")
    health = HealthDocument(**part.model_dump(), parts={"winding": part}, language="de")
    return own.model_copy(update={"health": health, "events": (event,), "findings": ()})


def watched(report: ReportDocument) -> str:
    table, console = LiveTable(lambda: ""), Terminal(file=io.StringIO(), width=100)
    table.add(report.to_json())
    console.print(table)
    return str(console.file.getvalue())  # type: ignore[attr-defined]


@pytest.fixture
def kept() -> ReportDocument:
    """The same report, in the history of its machine."""
    now = time.time()
    writer = HistoryWriter(history_path(SITE, MACHINE), Bounds(20_000_000, 3650, 24))
    writer.open(now)
    report = Numbers(now).number(german(now))
    writer.add(report)
    writer._write_waiting()
    writer._close()
    return report


def run(*arguments: str) -> str:
    return CliRunner().invoke(cli, arguments, env={"COLUMNS": "100"}, catch_exceptions=False).output


def test_what_a_person_reads_of_a_german_machine_has_commas(kept: ReportDocument, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    run("report", MACHINE, "--output", str(page))
    written = re.sub(r"<(style|svg)\b.*?</\1>|<[^>]*>", " ", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    shown = {
        "watch": watched(kept),
        "event": event_text(kept.events[0]),
        "recording": f"{operator_text(kept)}\n{report_text(kept)}",
        "history": run("history", MACHINE),
        "events": run("history", MACHINE, "--events", "--details"),
        "page": re.sub(r"Otolith [\d.]+", "", written),
    }
    assert {name: POINT.findall(text) for name, text in shown.items() if POINT.search(text)} == {}
    for name in ("watch", "event", "recording", "events", "page"):
        assert "3,1 h bis 4,9 h" in " ".join(shown[name].split())
    for name in ("watch", "recording", "history", "page"):
        assert "6,100" in shown[name]
    assert {"Wert", "Einheit", "Zustand", "seit"} <= set(re.findall(r"\w+", shown["history"].replace("Seit", "seit")))


def test_what_a_machine_reads_has_points(kept: ReportDocument) -> None:
    assert "6.100 ± 0.020 Ω (-6.15 %)" in kept.to_json()
    for arguments in (("history", MACHINE, "--json"), ("history", MACHINE, "--events", "--csv")):
        assert "6.100 ± 0.020" in run(*arguments)
    assert ",6.1," in run("history", MACHINE, "--csv", "--every", "window")


def test_the_curves_of_a_page_keep_their_points(kept: ReportDocument) -> None:
    page = run("report", MACHINE, "--output", "-")
    places = re.findall(r'points="([^"]*)"', page)
    assert places
    assert all(re.fullmatch(r"-?[\d.]+,-?[\d.]+", place) for row in places for place in row.split())
    del kept


@pytest.mark.parametrize(
    ("english", "expected"),
    [
        ("6.5 Ω (-7.91 %), 0.1%; -0.5 ± 1.5e-05", "6,5 Ω (-7,91 %), 0,1%; -0,5 ± 1,5e-05"),
        ("0.0047·sin(0.9988·θ + 1.55) mN·m", "0,0047·sin(0,9988·θ + 1,55) mN·m"),
        ("192.168.0.10:502, Otolith 0.9.0, 15:33:20.5", None),
        ("/srv/plant-1.5/drive.dbc, am 27.11. 15:33, 2026-01-31", None),
        ('delay = "9.7 ms", write `sd = 0.5`', None),
        ("U_dc.1 and register 40001", None),
    ],
)
def test_only_numbers_change(english: str, expected: str | None) -> None:
    german = texts_in("de").decimals(english)
    assert german == (expected or english)
    assert texts_in("de").decimals(german) == german  # twice is as once
    assert texts_in("en").decimals(english) == english


@given(st.text(max_size=80))
def test_no_text_becomes_longer(text: str) -> None:
    """Tables stay as they are."""
    german = texts_in("de").decimals(text)
    assert len(german) == len(text)
    assert german.replace(",", ".") == text.replace(",", ".")
