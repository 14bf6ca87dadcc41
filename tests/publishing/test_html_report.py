"""The page of ``otolith report``: well formed, without references, harmless, and readable in a browser."""

import json
import re
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from benchmarks.browser import Browser, browser, program

from benchmarks import pictures
from otolith.health.labels import TimeLabels
from otolith.health.limits import Level
from otolith.health.schema import (
    CountersDocument,
    EventChange,
    HealthDocument,
    NoteDocument,
    PartDocument,
    ReportDocument,
    Status,
)
from otolith.health.text import texts_in
from otolith.publishing.html_report import MAX_ROWS, Axis, html_report
from otolith.storage.history import DAY, HOUR, WINDOW, HistoryReader, history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from tests.storage.histories import MACHINE, SITE, START, document

NOW = START + 400.0
YEAR = 365.0 * DAY
VOID = {"meta", "link", "br", "line", "rect", "polygon", "polyline"}
"""Elements without an end, and those that the template closes by '/>'."""


class Page(HTMLParser):
    """The texts of a page; raises AssertionError where its elements are not nested, or refer to anything."""

    def __init__(self, text: str) -> None:
        super().__init__()
        assert not re.search(r"https?:|@import|url\(", text)
        self._open: list[str] = []
        self.texts: list[str] = []
        self.elements: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in {"script", "img", "iframe", "object", "form", "base"}
        self.elements.append(tag)
        if tag not in VOID:
            self._open.append(tag)
        for name, value in attrs:
            assert not name.startswith("on")
            is_own = value == "data:," or (tag == "a" and re.fullmatch(r"#condition-\d+", value or ""))
            assert name not in {"src", "href", "srcset", "action"} or is_own
            assert "url(" not in (value or "")
            assert "nan" not in (value or "").split() or name == "title"

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())


def state_of(level: Level, since: float, reason: str = "") -> HealthDocument:
    part = PartDocument(state=level, since=since, reason=reason)
    return HealthDocument(state=level, since=since, reason=reason, parts={"winding": part})


def written(
    reports: list[ReportDocument],
    *,
    machine: str = MACHINE,
    site: str = SITE,
    description: str = "",
    labels: TimeLabels = TimeLabels(),  # noqa: B008 - immutable
) -> HistoryReader:
    writer = HistoryWriter(history_path(site, machine), Bounds(20_000_000, 3650, 24))
    numbers, _ = writer.open(START)
    writer.description, writer.labels = description, labels
    for report in reports:
        writer.add(numbers.number(report.model_copy(update={"machine": machine, "site": site})))
        writer._write_waiting()
    writer._close()
    return writer.reader


def shown_text(reader: HistoryReader, *, now: float = NOW, since: float = START) -> str:
    return html_report(reader, reader.samples(WINDOW, since), "window", since, now)


def page(reader: HistoryReader, *, now: float = NOW, since: float = START) -> Page:
    return Page(shown_text(reader, now=now, since=since))


def reports(count: int, *, begin: float = START, health: HealthDocument | None = None) -> list[ReportDocument]:
    state = health or state_of(Level.OK, START)
    return [document(index, begin + 2.0 * (index + 1)).model_copy(update={"health": state}) for index in range(count)]


def test_a_machine_without_events_is_ok_and_there_is_nothing_to_do() -> None:
    text = page(written(reports(200))).text
    assert "OK since 2023-11-14" in text
    assert "What to do: nothing." in text
    assert "Events None." in text
    assert "Nothing was lost." in text


def test_one_window_is_a_point() -> None:
    shown = page(written(reports(1)), now=START + 2.0)
    assert "polyline" in shown.elements
    assert "6.500 ± 0.020 Ω" in shown.text


def test_a_history_without_a_report_is_no_data() -> None:
    text = page(written([])).text
    assert "UNKNOWN The history has no report. What to do:" in text


def test_a_parameter_without_a_value_is_named_with_reason_and_advice() -> None:
    report = reports(1, health=state_of(Level.NO_DATA, START, "not determined yet: R_a"))[0]
    parameter = report.parameters["R_a"].model_copy(
        update={"value": None, "sd": None, "low": None, "high": None, "status": Status.UNESTIMATED,
                "reason": "the motor is at rest", "advice": "let it turn"})  # fmt: skip
    text = page(written([report.model_copy(update={"parameters": {"R_a": parameter}})]), now=START + 2.0).text
    assert "UNKNOWN since" in text
    assert "not determined yet: R_a" in text
    assert "No value in this time." in text
    assert "R_a : not estimated in 1 of the last 1 windows: the motor is at rest What would help: let it turn" in text


def test_gaps_are_hatched_and_interrupt_the_curve() -> None:
    both = [*reports(50), *reports(50, begin=START + 300.0)]
    shown = page(written(both))
    assert shown.elements.count("polygon") == 2
    assert "hatched: no values" in shown.text


def test_a_daemon_that_has_stopped_is_no_data_with_the_last_state() -> None:
    text = page(written(reports(50, health=state_of(Level.ACT, START, "worn"))), now=START + 7300.0).text
    assert "UNKNOWN no report since" in text
    assert "(2 h)" in text
    assert "The last report: ACT since" in text
    well = page(written(reports(50, health=state_of(Level.OK, START))), now=START + 7300.0).text
    assert "whole machine UNKNOWN" in well
    assert "No limit is passed" not in well


def test_an_event_has_its_states_and_its_evidence() -> None:
    changed = reports(200, health=state_of(Level.WATCH, START + 100.0, "short circuit between turns"))
    raised = document(50, START + 102.0, change=EventChange.RAISED).events[0]
    cleared = raised.model_copy(update={"change": EventChange.CLEARED, "end": START + 300.0})
    for index, event in ((50, raised), (150, cleared)):
        changed[index] = changed[index].model_copy(update={"events": (event,)})
    text = page(written(changed)).text
    assert text.count("winding: short circuit between turns") == 1
    assert "cleared winding: short circuit" in text
    assert "windows 50 to 50" in text


def test_a_long_history_of_events_is_cut() -> None:
    many = [document(index, START + 2.0 * index, change=EventChange.RAISED) for index in range(1, MAX_ROWS + 20)]
    text = page(written(many)).text
    assert f"and 19 more: otolith history {MACHINE} --events" in text


def test_lost_data_of_the_time_are_counted_over_restarts(monkeypatch: pytest.MonkeyPatch) -> None:
    reader = written(reports(20))
    hour = START // HOUR * HOUR
    counted = [(hour, -1e5, 5, 1), (hour + 2 * HOUR, -1e5, 9, 3), (hour + 3 * HOUR, 9e3, 2, 1)]
    rows = [
        {
            "hour": begin,
            "run": START + run,
            **CountersDocument(received=number, lost=number, windows=windows).model_dump(),
        }
        for begin, run, number, windows in counted
    ]
    monkeypatch.setattr(HistoryReader, "counters", lambda *_: rows)
    text = page(reader).text
    assert "Received: 6 samples in 3 windows." in text
    assert "6 samples lost" in text


def test_each_loss_has_words(monkeypatch: pytest.MonkeyPatch) -> None:
    reader = written(reports(1))
    losses = dict.fromkeys(CountersDocument.model_fields, 7)
    monkeypatch.setattr(HistoryReader, "counters", lambda *_: [{"hour": START, "run": START, **losses}])
    lost = page(reader, now=START + 2.0).text.partition("Lost data")[2].partition("Made")[0]
    assert lost.count("7 ") == len(losses)
    assert not [name for name in losses if "_" in name and name in lost]


HARMFUL = "<script>window.hit=1<"
LONG = "a_parameter_with_a_name_that_is_longer_than_a_phone_is_wide"
TEXT = "\"'><img src=x onerror='window.hit=1'>&lt;"


DESCRIPTION = json.dumps({
    "title": TEXT, "equations": [[TEXT, LONG * 3]], "values": {LONG: [1.0, TEXT, TEXT]}, "limits": {}, "sites": {},
})  # fmt: skip


def harmful() -> HistoryReader:
    report = reports(3, health=state_of(Level.ACT, START, TEXT))[-1]
    event = document(3, START, change=EventChange.RAISED).events[0]
    texts = dict.fromkeys(("part", "condition", "text", "advice", "cause", "source"), TEXT)
    finding = report.model_copy(update={"findings": document(1, START).findings}).findings[0]
    parameter = report.parameters["R_a"].model_copy(
        update={"unit": TEXT, "reason": TEXT, "status": Status.HELD, "advice": TEXT}
    )
    harm = finding.model_copy(update={"text": TEXT, "condition": TEXT})
    update = {"events": (event.model_copy(update=texts),), "parameters": {TEXT: parameter, LONG: parameter},
              "findings": (harm,), "notes": (TEXT,), "twin": TEXT}  # fmt: skip
    return written([report.model_copy(update=update)], machine=HARMFUL, site=HARMFUL, description=DESCRIPTION)


def test_texts_of_the_machine_are_harmless() -> None:
    shown = page(harmful(), now=START + 6.0)
    assert HARMFUL in shown.text
    assert shown.text.count("onerror") > 10


@pytest.mark.parametrize("span", [0.5, 7.0, 100.0, 3600.0, 5e4, 7.0 * DAY, 40.0 * DAY, 3.0 * YEAR, 9.0 * YEAR])
def test_marks_of_time_are_few_and_at_round_times(span: float) -> None:
    marks = Axis(START, START + span, START + 1.2 * span).ticks(texts_in("en"))
    assert len(marks) <= 5
    assert span < 2.0 or len(marks) >= 2
    assert all(0.0 <= place <= 100.0 for place, _ in marks)
    assert len({text for _, text in marks}) == len(marks)


def test_a_history_of_an_earlier_version_has_no_lanes_but_is_shown() -> None:
    reader = written(reports(20))
    with sqlite3.connect(reader.path) as connection:
        connection.executescript("DROP TABLE state; DROP TABLE description; PRAGMA user_version = 1")
    text = page(reader, now=START + 40.0).text
    assert "OK since" in text
    assert "The history has none: otolith twin show dc_motor" in text


COUNTS = {"degrading": 55, "unbalance": 40, "sensor-fault": 48}
"""Windows of each simulated situation: shortly after what is announced last."""
ANNOUNCED = {
    "degrading": ("WATCH winding: short circuit between turns", "reaches ACT in", "measure resistance and insulation"),
    "unbalance": ("ACT shaft: unbalanced shaft", "amplitude", "balance the rotor", "+ (1/J)·U1", "ACT 4", "mN·m"),
    "sensor-fault": ("ACT sensors: a sensor is wrong", "check the sensor and its cable", "R_a, D : not estimated in"),
}


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The page of each situation, and a German one."""
    reports = {name: pictures.simulated(name, count) for name, count in COUNTS.items()}
    last = reports["unbalance"][-1]
    german = last.document.to_json().replace('"language":"en"', '"language":"de"').replace('"ACT"', '"WATCH"')
    reports["german"] = [*reports["unbalance"][:-1], replace(last, document=ReportDocument.from_json(german))]
    return {name: pictures.page(rows, tmp_path_factory.mktemp(name)) for name, rows in reports.items()}


@pytest.mark.parametrize("situation", COUNTS)
def test_a_simulated_machine_is_described_in_words(simulated: dict[str, str], situation: str) -> None:
    shown = Page(simulated[situation])
    for text in (*ANNOUNCED[situation], "domega/dt = (K_t·i - T_load - D·omega) / J", "armature resistance"):
        assert text in shown.text


def test_a_curve_has_a_unit_and_the_digits_of_its_value(simulated: dict[str, str]) -> None:
    page = simulated["unbalance"]
    cards = [card for card in page.split('<section class="card">') if 'class="l-value"' in card]
    assert cards
    for card in cards:
        title, value = (" ".join(re.sub(r"<[^>]*>", " ", card.partition(begin)[2].partition(end)[0]).split())
                        for begin, end in (("<h3>", "</h3>"), ('<span class="now">', "</div>")))  # fmt: skip
        number, unit = re.match(r"(\S+) ± \S+ (\S+)", value).groups()  # type: ignore[union-attr]
        assert title.endswith(f" in {unit}")
        assert re.search(rf'class="l-value"[^>]*>{re.escape(number)}<', card)


def test_a_far_limit_is_only_in_words(simulated: dict[str, str]) -> None:
    shown = Page(simulated["degrading"])
    assert "WATCH above 9.425" in shown.text
    assert {"WATCH 6.37", "ACT 6.175"} <= set(shown.texts)
    assert not {"WATCH 9.425", "ACT 10.73"} & set(shown.texts)


@pytest.fixture(scope="module")
def tab() -> Iterator[Browser]:
    if (path := program()) is None:
        pytest.skip("no browser: apt install chromium")
    with browser(path) as opened:
        yield opened


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (390, 844), (360, 740)])
def test_a_page_logs_and_requests_nothing_in_a_browser(
    simulated: dict[str, str], tab: Browser, tmp_path: Path, width: int, height: int
) -> None:
    silent = shown_text(written(reports(50, health=state_of(Level.OK, START))), now=START + 7300.0)
    own = {"harmful": shown_text(harmful()), "silent": silent, "empty": shown_text(written([]))}
    for name, text in {**simulated, **own}.items():
        path = tmp_path / f"{name}.html"
        path.write_text(text, encoding="utf-8")
        tab.open(path, width, height, is_phone=width < 500)
        assert tab.console() == []
        assert [address for address in tab.requested() if address != "data:,"] == [path.as_uri()]
        assert tab.value("window.hit") is None
        assert tab.value("innerWidth") == width  # a phone shows a page that is too wide as smaller
        assert tab.value("document.documentElement.scrollWidth") <= width
        assert tab.value(VERDICT) <= height
        assert tab.value(SMALLEST) >= 11
        assert name == "harmful" or tab.value(SPLIT) == []
        assert tab.value(CUT) == []
        assert tab.value(LANES) or name == "empty"


def test_a_page_is_dark_for_who_prefers_that(simulated: dict[str, str], tab: Browser, tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text(simulated["unbalance"], encoding="utf-8")
    for is_dark in (False, True):
        tab.open(path, 390, 844, is_phone=True, is_dark=is_dark)
        card = tab.value(BRIGHTNESS.format("backgroundColor", ".card"))
        assert (card < 60) is is_dark
        for text in ("body", ".pale", ".do b", ".l-ACT", ".l-WATCH"):
            assert abs(card - tab.value(BRIGHTNESS.format("color", text))) > 100, text
        assert tab.value("document.documentElement.scrollWidth") <= 390


BRIGHTNESS = """(() => {{
  const numbers = getComputedStyle(document.querySelector('{1}')).{0}.match(/\\d+/g).map(Number);
  return (numbers[0] + numbers[1] + numbers[2]) / 3;
}})()"""
"""Of a colour of the first such element, 0 to 255."""
LANES = """[...document.querySelectorAll('.lane .bar')].every(
  bar => [...bar.querySelectorAll('i')].some(part => part.getBoundingClientRect().width >= 1)
) && document.querySelectorAll('.lane .bar').length > 0"""
"""Whether each part has a lane that shows its states."""
FIRST = "document.querySelectorAll('.verdict > .badge, .verdict .event:first-of-type')"
VERDICT = f"Math.max(...[...{FIRST}].map(row => row.getBoundingClientRect().bottom))"
"""Lower edge of the state and of the first event, px."""
SMALLEST = (
    "Math.min(...[...document.querySelectorAll('body *')].map(row => parseFloat(getComputedStyle(row).fontSize)))"
)
"""Size of the smallest text, px."""
CUT = """[...document.querySelectorAll('.labels span, .ticks span')].filter(
  row => row.getBoundingClientRect().right > row.parentElement.getBoundingClientRect().right
).map(row => row.textContent)"""
"""Labels of plots and of their axes that are cut at the right edge."""
SPLIT = r"""(() => {
  const split = [], range = document.createRange();
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode())
    for (const number of texts.currentNode.data.matchAll(/\d[\d.:-]*|\b[A-Z]+\b/g)) {
      range.setStart(texts.currentNode, number.index);
      range.setEnd(texts.currentNode, number.index + number[0].length);
      if (new Set([...range.getClientRects()].map(part => Math.round(part.top))).size > 1) split.push(number[0]);
    }
  return split;
})()"""
"""Numbers, times and states that do not stand on one line."""


def test_a_printed_page_has_few_sheets_of_paper(simulated: dict[str, str], tab: Browser, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text(simulated["unbalance"], encoding="utf-8")
    tab.open(path, 1280, 720)
    sheets = tab.pages()
    assert sheets.startswith(b"%PDF")
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b", sheets)) <= 3
    assert re.search(rb"/MediaBox\s*\[\s*0 0 59[45]\.?\d* 84[12]", sheets)  # A4


def test_times_of_ours_are_those_of_the_plant_and_words_of_a_person_stay() -> None:
    note = NoteDocument(at=START, by="anna", text="since 2026-01-31 12:00:00 UTC")
    update = {"comments": (note,), "timezone": "Europe/Berlin", "text": "R_a since 2026-01-30 12:00:00 UTC"}
    raised = document(0, START + 2.0, change=EventChange.RAISED).events[0].model_copy(update=update)
    health = state_of(Level.OK, START).model_copy(update={"timezone": "Europe/Berlin"})
    own = [report.model_copy(update={"events": (raised,)}) for report in reports(1, health=health)]
    text = page(written(own), now=START + 2.0).text
    assert "2026-01-31 12:00:00 UTC" in text
    assert "2026-01-30 13:00:00 CET" in text
