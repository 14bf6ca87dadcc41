"""While a cause is not yet known, each screen says what is new and what to do; none says that all is well."""

import io
import re
from pathlib import Path

import pytest

from otolith.cli.console import Terminal
from otolith.cli.operation.live_table import LiveTable
from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.hypotheses import FaultType
from otolith.estimation.information import Outcome
from otolith.health.labels import Numbers
from otolith.health.limits import Level
from otolith.health.schema import (
    AlternativeDocument,
    EventDocument,
    EvidenceDocument,
    FindingDocument,
    FindingKind,
    FitDocument,
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
from otolith.storage.history_writer import Bounds, HistoryWriter
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


@pytest.mark.parametrize("language", ["en", "de"])
def test_what_is_known_and_grave_comes_before_what_is_open(language: Language, tmp_path: Path) -> None:
    """Nobody is told to let a machine run that is at ACT."""
    say, base = texts_in(language), undecided(language)
    assert base.health is not None
    health = base.health.model_copy(update={"state": Level.ACT})
    event = EventDocument(
        id="limit/R_a@1", part="winding", state=Level.ACT, start=START, since=START, condition="worn", text="far off",
        advice="call", evidence=EvidenceDocument(windows=(1, 2)), language=language,
    )  # fmt: skip
    document = base.model_copy(update={"health": health, "events": (event,)})
    for name, text in shown(document, tmp_path).items():
        assert -1 < text.find("far off") < text.find("something new"), name
        assert say("undecided_advice") not in text, name


def test_the_specialist_reads_no_cause_twice() -> None:
    base, formulas = undecided("en"), "a sensor is wrong: omega 0.25·sin(1·θ) rad/s (13%); or K (9%)"
    finding = base.findings[0].model_copy(update={"text": formulas})
    reason = f"this window differs from the prediction; {formulas}; not explained"
    parameters = {name: row.model_copy(update={"reason": reason}) for name, row in base.parameters.items()}
    table, console = LiveTable(lambda: "", details=True), Terminal(file=io.StringIO(), width=200)
    table.add(base.model_copy(update={"findings": (finding,), "parameters": parameters}).to_json())
    console.print(table)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("sin(") == 1
    assert "this window differs from the prediction; not explained" in text


@pytest.mark.parametrize("details", [False, True])
def test_causes_that_are_equally_likely_have_formulas_for_the_specialist_only(details: bool) -> None:
    """A class that is no event yet is open to people, as is a test that goes on."""
    formulas = "several hypotheses explain it: shaft: 0.0047·sin(1·θ) N·m"
    base = undecided("en")
    finding = base.findings[0].model_copy(
        update={"id": "undecided", "kind": FindingKind.CLASS, "condition": "equally", "text": formulas}
    )
    causes = tuple(AlternativeDocument(reason=FaultType.COMPONENT, text=formulas, probability=0.5) for _ in range(2))
    parameters = {name: row.model_copy(update={"reason": formulas}) for name, row in base.parameters.items()}
    document = base.model_copy(update={"findings": (finding,), "explanations": causes, "parameters": parameters})
    table, console = LiveTable(lambda: "", details=details), Terminal(file=io.StringIO(), width=200)
    table.add(document.to_json())
    console.print(table)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "(2 possible causes)" in text
    assert ("sin(" in text) is details


def uncommissioned(language: Language, *, explained: bool) -> ReportDocument:
    """A report of a machine whose twin still computes with the values of its example."""
    base = undecided(language)
    parameters = {name: row.model_copy(update={"is_example": True}) for name, row in base.parameters.items()}
    fit = FitDocument(
        rmse_configured={}, rmse_estimated={"i": 0.2}, explained=explained, cost=0.9 if explained else 24.3,
        variance_ratio=1.0, outcome=Outcome.AGREED, units={"i": "A"},
    )  # fmt: skip
    return base.model_copy(update={"parameters": parameters, "fit": fit, "findings": ()})


@pytest.mark.parametrize("language", ["en", "de"])
def test_before_commissioning_what_does_not_fit_is_the_file_and_the_advice_is_to_commission(
    language: Language, tmp_path: Path
) -> None:
    say, document = texts_in(language), uncommissioned(language, explained=False)
    for name, text in shown(document, tmp_path).items():
        assert "otolith commission" in text, name
        assert say("undecided_advice") not in text, name
        assert say("changed") not in text, name


@pytest.mark.parametrize("language", ["en", "de"])
def test_a_fault_of_a_machine_that_was_as_its_file_says_is_none_of_the_file(language: Language, tmp_path: Path) -> None:
    """To commission it would write the fault into the file."""
    say, document = texts_in(language), uncommissioned(language, explained=False)
    assert document.health is not None
    health = document.health.model_copy(update={"has_agreed": True})
    document = document.model_copy(update={"health": health, "findings": undecided(language).findings})
    for name, text in shown(document, tmp_path).items():
        assert "otolith commission" not in text, name
        assert say("undecided_advice") in text, name


def test_where_the_example_explains_the_machine_nothing_is_advised(tmp_path: Path) -> None:
    for name, text in shown(uncommissioned("en", explained=True), tmp_path).items():
        assert "otolith commission" not in text, name


@pytest.mark.parametrize("explained", [False, True])
def test_the_words_beside_the_residual_are_those_of_the_window(explained: bool) -> None:
    table, console = LiveTable(lambda: "", details=True), Terminal(file=io.StringIO(), width=200)
    table.add(uncommissioned("en", explained=explained).to_json())
    console.print(table)
    (line,) = (row for row in console.file.getvalue().splitlines() if "RMSE" in row)  # type: ignore[attr-defined]
    assert ("not explained" in line) is not explained
    assert ("0.9 times" if explained else "24 times") in line


def test_a_window_that_nothing_explains_is_not_said_to_be_explained() -> None:
    """Values at their bounds may leave no residual, which no machine has."""
    document = uncommissioned("en", explained=True).model_copy(update={"decision": WindowDecision.REFUSED})
    table, console = LiveTable(lambda: ""), Terminal(file=io.StringIO(), width=200)
    table.add(document.to_json())
    console.print(table)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "not explained" in text
    assert "otolith commission" in text
