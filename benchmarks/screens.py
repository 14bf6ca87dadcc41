"""Every screen of the docs, from one seeded run of the demo's scenario: what a person sees, and when.

    make screens

writes ``docs/screens.md`` and its pictures, and those of README and ``docs/history.md``. A headless Chromium shows the
pages.
"""

import io
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from unittest import mock

import click
from click.testing import CliRunner
from rich.console import Console, RenderableType

from benchmarks import site_pictures
from benchmarks.browser import Browser, browser, program
from benchmarks.motor import CONFIG, RECORDS, windows
from benchmarks.pictures import reduced, write_situations
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.cli.console import Terminal
from otolith.cli.demo import Demo
from otolith.cli.main import cli
from otolith.cli.operation.live_table import LiveTable
from otolith.health.schema import CountersDocument, Report, ReportDocument
from otolith.health.text import undecided_text
from otolith.machine import LoadedMachine, load_machine
from otolith.publishing.html_report import html_report
from otolith.publishing.recorder import operator_text, report_text
from otolith.storage.history import SUFFIX, WINDOW, HistoryReader, describe_machine
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.plant.scenario import load_scenario, simulate

START = 1_795_770_000.0  # Unix s of the first record: 2026-11-27, 10:00 in Berlin
ZONE = "Europe/Berlin"
SECONDS = 90.0
WIDTHS = (60, 80, 120)  # characters of terminals
WINDOWS_OF_PAGES = {"1280": (1280, 800), "390": (390, 844)}  # pixels: a PC, a phone
SCENARIO = CONFIG / "scenarios" / "demo.toml"
NAME, SITE = "dc-motor", "demo"
DOCS = Path(__file__).parents[1] / "docs"
INTRODUCTION = """# Screens

What a person sees of the demo's motor: the armature resistance falls from 15 s on, and the rotor gets out of balance at
45 s. Each screen says the state, since when, and what to do. `make screens` makes this page from a seeded run of the
same scenario, in a minute or two; times are those of a plant in Berlin.
"""


@dataclass(frozen=True, slots=True)
class Story:
    """The reports of the run, and the moments that are shown."""

    machine: LoadedMachine
    reports: Sequence[Report]

    @property
    def documents(self) -> list[ReportDocument]:
        """The reports without their curves."""
        return [report.document for report in self.reports]

    def until(self, moment: str) -> list[ReportDocument]:
        """Return the reports up to ``healthy``, ``undecided`` or ``end``."""
        documents = self.documents
        if moment == "end":
            return documents
        if moment == "healthy":
            return documents[:6]
        return documents[: 1 + next(index for index, row in enumerate(documents) if undecided_text(row))]


def story(folder: Path, language: str = "en") -> Story:
    """Return the run of a machine with texts in a language; its file is in ``folder`` afterwards."""
    shutil.copytree(CONFIG, folder, dirs_exist_ok=True)
    path = folder / "dc-motor.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("[machine]\n", f'[machine]\nlanguage = "{language}"\n', 1), encoding="utf-8")
    machine, scenario = load_machine(path), load_scenario(SCENARIO)
    state = initial_state(machine.file.machine.name, machine.file.machine.site, machine.problem, machine.plan)
    reports = []
    for window in windows(scenario, round(SECONDS / (RECORDS * scenario.sample_period))):
        state, report = adapt(state, replace(window, start=START + window.start))
        count = (window.index + 1) * RECORDS * len(machine.twin.signals)
        counters = CountersDocument(received=count, windows=window.index + 1)
        reports.append(replace(report, document=report.document.model_copy(update={"counters": counters})))
    return Story(machine, reports)


def watched(documents: Sequence[ReportDocument], *, details: bool = False) -> LiveTable:
    """Return what 'otolith watch' shows after these reports."""
    table = LiveTable(lambda: "", details=details)
    for document in documents:
        table.add(document.to_json())
    return table


def svg(shown: RenderableType, width: int, title: str) -> str:
    """Return a terminal with a text as SVG, in the fonts of the reader."""
    console = Console(record=True, width=width, file=io.StringIO(), force_terminal=True, color_system="truecolor")
    console.print(shown)
    text = console.export_svg(title=title, unique_id="screen")
    return re.sub(r"@font-face \{.*?\}\s*", "", text, flags=re.DOTALL)  # none from the network


def plain_demo(run: Story, folder: Path) -> str:
    """Return what ``make demo`` prints where there is no terminal."""
    with mock.patch.dict(os.environ, {"XDG_STATE_HOME": str(folder)}):
        demo = Demo(run.machine.path, SCENARIO, SECONDS, as_json=False)
    output = io.StringIO()
    demo._console = Terminal(file=output, width=100)
    demo._history.parent.mkdir(parents=True)
    demo._history.touch()
    scenario = load_scenario(SCENARIO)
    samples = islice(simulate(scenario), 0, round(SECONDS / scenario.sample_period), 10)
    rows = [(START + sample.time, *sample.truth.values()) for sample in samples]
    names = ("t", *next(simulate(scenario)).truth)
    lines = [
        ",".join(names),
        *(",".join(f"{value:.9g}" if value < 1e9 else f"{value:.4f}" for value in row) for row in rows),
    ]
    (demo._folder / "truth.csv").write_text("\n".join(lines), encoding="utf-8")
    demo._add(run.documents, echo=True)
    demo._verdict()
    text = output.getvalue().replace(str(demo._folder), "~/.local/state/otolith/demo/20261127T100000-1234")
    text = re.sub(r"dc-motor-\d{8}T\d{6}-\d+", "dc-motor-20261127T100000-1234", text)
    return text.replace(str(Path(sys.executable).with_name("otolith")), ".venv/bin/otolith")


def history_of(run: Story, folder: Path) -> Path:
    """Return the path of the history of a run, which is in ``folder`` afterwards."""
    path = folder / f"{SITE}.{NAME}{SUFFIX}"
    writer = HistoryWriter(path, Bounds(200_000_000, 3650.0, 24.0))
    numbers, _ = writer.open(START)
    writer.description = describe_machine(run.machine.twin, run.machine.plan)
    with mock.patch("time.time", return_value=run.documents[-1].window.end):  # the age of windows at the end of the run
        for document in run.documents:
            writer.add(numbers.number(document))
            writer.write()
        writer.stop(0.0)
        writer.write()
    return path


def printed(path: Path, *options: str) -> str:
    """Return what 'otolith history' prints of a history."""
    result = CliRunner().invoke(cli, ["history", str(path), *options], env={"COLUMNS": "80"}, catch_exceptions=False)
    return str(result.stdout)


def page_of(path: Path, end: float) -> str:
    """Return the report page of a history."""
    reader = HistoryReader.of_file(path)
    return html_report(reader, reader.samples(WINDOW, START), "window", START, end)


def page_pictures(tab: Browser, pages: dict[str, str], folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield name and PNG of each page in each window, light and dark."""
    for name, text in pages.items():
        file = folder / f"{name}.html"
        file.write_text(text, encoding="utf-8")
        for width, size in WINDOWS_OF_PAGES.items():
            for scheme in ("light", "dark"):
                tab.open(file, *size, is_phone=width == "390", is_dark=scheme == "dark")
                yield f"{name}-{width}-{scheme}", reduced(tab.picture(), size)


def terminals(run: Story, german: Story) -> dict[str, str]:
    """Return the SVG of each terminal by its name."""
    end, undecided = run.until("end"), run.until("undecided")
    shown = {f"watch-{width}": (end, width) for width in WIDTHS}
    shown |= {f"watch-undecided-{width}": (undecided, width) for width in (60, 80)}
    shown |= {"watch-healthy-80": (run.until("healthy"), 80), "watch-details-120": (undecided, 120)}
    shown |= {"watch-german-80": (german.until("end"), 80), "demo": (end, 120)}  # the last one is of the README
    pictures = {}
    with mock.patch("time.monotonic", return_value=0.0):  # each report has just come
        for name, (documents, width) in shown.items():
            details = "details" in name
            table, title = watched(documents, details=details), f"otolith watch{' --details' if details else ''}"
            pictures[name] = svg(table, width, title)
    return pictures


def document_of(texts: dict[str, str]) -> str:
    """Return the page of the docs: pictures by their names, and texts of terminals."""
    pictures = {
        "The live table": [
            ("watch-healthy-80", "A healthy motor, 80 columns"),
            ("watch-undecided-80", "Something has changed, and the cause is not yet known"),
            ("watch-undecided-60", "The same in 60 columns"),
            ("watch-details-120", "The same for the specialist, with `--details`"),
            ("watch-120", "At the end, 120 columns"), ("watch-80", "80 columns"), ("watch-60", "60 columns"),
            ("watch-german-80", 'A machine with `language = "de"`'),
        ],
        "The report page": [
            ("page-1280-light", "On a PC"), ("page-1280-dark", "On a PC that prefers dark pages"),
            ("page-390-light", "On a phone"), ("page-390-dark", "On a phone that prefers dark pages"),
            ("page-undecided-390-light", "While the cause is not yet known"),
            ("page-german-390-light", "In German"),
        ],
    }  # fmt: skip
    parts = [INTRODUCTION]
    for title, rows in pictures.items():
        parts += [f"## {title}\n"]
        for name, meaning in rows:
            suffix = "png" if name.startswith("page") else "svg"
            width = ' width="390"' if "-390-" in name else ""
            image = f'<img src="pictures/{name}.{suffix}" alt="{meaning}"{width}>'
            parts += [f"{meaning}:\n", image if width else f"![{meaning}](pictures/{name}.{suffix})", ""]
    for title, text in texts.items():
        parts += [f"## {title}\n", "```text", *(line.rstrip() for line in text.strip("\n").splitlines()), "```", ""]
    return "\n".join(parts)


@click.command(help=__doc__)
def main() -> None:
    os.environ["TZ"] = ZONE
    time.tzset()
    if (path := program()) is None:
        sys.exit("no browser: apt install chromium")
    pictures = DOCS / "pictures"
    with tempfile.TemporaryDirectory() as name, browser(path) as tab:
        folder = Path(name)
        run, german = (story(folder / language, language) for language in ("en", "de"))
        for key, text in terminals(run, german).items():
            (pictures / f"{key}.svg").write_text(text, encoding="utf-8")
        undecided = replace(run, reports=run.reports[: len(run.until("undecided"))])
        stories = {"page": run, "page-undecided": undecided, "page-german": german}
        histories = {}
        for key, each in stories.items():
            (place := folder / key).mkdir()
            histories[key] = history_of(each, place)
        pages = {key: page_of(histories[key], each.documents[-1].window.end) for key, each in stories.items()}
        for key, content in page_pictures(tab, pages, folder):
            if key.startswith(("page-1280", "page-390")) or key.endswith("390-light"):
                (pictures / f"{key}.png").write_bytes(content)
        last, between = run.documents[-1], undecided.documents[-1]
        texts = {
            "The demo without a terminal": plain_demo(run, folder / "state"),
            "`otolith history dc-motor`": printed(histories["page"], "--since", "1h"),
            "`otolith history dc-motor --events`": printed(histories["page"], "--since", "1h", "--events"),
            "The same in German": printed(histories["page-german"], "--since", "1h", "--events"),
            "The operator's text in a recording": operator_text(last),
            "The same while the cause is not yet known": operator_text(between),
            "The engineer's text in a recording": report_text(last),
        }
        (DOCS / "screens.md").write_text(document_of(texts), encoding="utf-8")
        write_situations(pictures, tab)
        for key, content in site_pictures.pictures(tab, folder):
            (pictures / f"{key}.png").write_bytes(content)


if __name__ == "__main__":
    main()
