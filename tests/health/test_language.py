"""The texts: every language has the same texts, and what people read is in the language of the machine."""

import io
import re
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.cli.operation.live_table import LiveTable
from otolith.cli.replay import ReplaySummary
from otolith.health import text as module
from otolith.health.limits import Level
from otolith.health.observations import BUS, DAEMON, SENSORS
from otolith.health.schema import LANGUAGES, CountersDocument, Language, ReportDocument
from otolith.health.text import announcements, event_text, headline, texts_in
from otolith.machine import LoadedMachine, find_twin, library_twins, load_machine, load_rules
from otolith.publishing.html_report import html_report
from otolith.publishing.recorder import operator_text, report_text
from otolith.publishing.recording_layout import blueprint
from otolith.storage.history import SUFFIX, WINDOW, describe_machine
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.base import Sampling
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.conftest import EXAMPLES, SIGNALS

GERMAN = texts_in("de")
OTHERS = [language for language in LANGUAGES if language != "en"]


def names(text: str) -> list[str]:
    return sorted(re.findall(r"{(\w+)}", text))


@pytest.mark.parametrize("language", OTHERS)
def test_every_language_has_the_same_keys_and_names(language: Language) -> None:
    own, english = texts_in(language), texts_in("en")
    assert {key: names(text) for key, text in own.texts.items()} == {
        key: names(text) for key, text in english.texts.items()
    }
    assert {key: set(texts) for key, texts in own.rules.items()} == {
        key: set(texts) for key, texts in english.rules.items()
    }
    assert set(english.rules) == {rule.id for rule in load_rules()}
    assert all(text == text.strip() and text for texts in own.rules.values() for text in texts.values())
    assert all(names(phrase) == names(text) for phrase, text in own.phrases.items())


def test_files_and_languages_are_the_same() -> None:
    folder = Path(module.__file__).parent / "texts"
    assert {path.stem for path in folder.glob("*.toml")} == set(LANGUAGES)
    for path in folder.glob("*.toml"):
        assert set(tomllib.loads(path.read_text(encoding="utf-8"))) <= {"texts", "conditions", "rules", "phrases"}


@pytest.mark.parametrize("language", OTHERS)
def test_what_the_library_and_the_states_name_is_translated(language: Language) -> None:
    twins = [find_twin(name) for name in library_twins()]
    words = {BUS, SENSORS, DAEMON} | {str(level) for level in Level} - {"OK"}
    for twin in twins:
        words |= {parameter.meaning for parameter in twin.parameters} | {site.meaning for site in twin.sites}
        words |= {row.meaning for rows in (twin.inputs, twin.outputs, twin.states) for row in rows} | {twin.title}
        words |= {figure.meaning for figure in twin.performance}
        words |= {parameter.part for parameter in twin.parameters} | {site.part for site in twin.sites}
    assert words - set(texts_in(language).phrases) - {""} == set()


@pytest.mark.parametrize("language", OTHERS)
def test_every_phrase_is_one_that_the_program_composes(language: Language) -> None:
    """Its longest part without a name or mark is in the source: a text that changes there changes here."""
    folder = Path(module.__file__).parents[1]
    paths = [path for path in folder.rglob("*") if path.suffix in {".py", ".toml"} and path.parent.name != "texts"]
    source = "".join(path.read_text(encoding="utf-8") for path in paths)
    parts = {
        phrase: max(re.split(r"{\w+}|[:;,()]| if ", phrase), key=len).strip() for phrase in texts_in(language).phrases
    }
    assert {phrase: part for phrase, part in parts.items() if part not in source} == {}


@pytest.mark.parametrize(
    ("english", "german"),
    [
        (
            "a sensor is wrong: V reads wrong by -0.3%: check the sensor and its scale (>99%); or K (1%)",
            "ein Sensor misst falsch: V zeigt um -0.3% falsch an: Sensor und Skalierung prüfen (>99 %); oder K (1 %)",
        ),
        (
            "i is frozen at 3 A for 2 s (20 samples) from t = 4 s although the twin predicts changes",
            "i steht seit t = 4 s für 2 s (20 Messwerte) auf 3 A fest, obwohl der Zwilling Änderungen vorhersagt",
        ),
        (
            "i is clipped at 3 A from t = 4 s: 20 of 100 records do not count; look at the range of the sensor",
            "i ist ab t = 4 s bei 3 A begrenzt: 20 von 100 Datensätzen zählen nicht; Messbereich des Sensors prüfen",
        ),
        (
            (
                "if these readings are right, write checks = [] under i in [signals]; "
                "3 records are fewer than 5, which a window needs"
            ),
            (
                "wenn diese Messwerte stimmen, checks = [] unter i in [signals] eintragen; "
                "3 Datensätze sind weniger als 5, die ein Zeitfenster braucht"
            ),
        ),
        (
            "a step of V_a from 3 to 5 V would decide if the other inputs stay as they are",
            "ein Sprung von V_a von 3 auf 5 V würde entscheiden, wenn die anderen Eingangsgrößen bleiben, wie sie sind",
        ),
        (
            "a signal is late: i is 5 ms late (4 to 6) (9%); write delay = 5 under [signals] i",
            "ein Signal kommt verspätet: i kommt 5 ms zu spät (4 bis 6) (9 %); delay = 5 eintragen unter [signals] i",
        ),
        (
            "only the last 3 of 4 records are estimated from, as more need too much memory",
            "nur aus den letzten 3 von 4 Datensätzen wird geschätzt, da mehr zu viel Speicher brauchen",
        ),
        (
            "write at most 2 s as length under [window], or a longer sample_period",
            "unter [window] als length höchstens 2 s eintragen, oder eine längere sample_period",
        ),
        (
            "nothing is estimated from this window: Q was below 1 m³/h for 5 s, in which no equation of the twin holds",
            (
                "aus dem Zeitfenster wird nichts geschätzt: Q lag unter 1 m³/h, 5 s lang; "
                "so lange gilt keine Gleichung des Zwillings"
            ),
        ),
        (
            "the drive was switched off for 3 s, in which no equation of the twin holds",
            "der Antrieb war abgeschaltet, 3 s lang; so lange gilt keine Gleichung des Zwillings",
        ),
        ("5% of i is missing, more than missing_limit (1%)", "5% von i fehlen, mehr als missing_limit (1%)"),
        ("shaft: -0.004·sin(angle(omega)) N*m", "shaft: -0.004·sin(angle(omega)) N*m"),
        ("a sentence with {braces} of somebody", "a sentence with {braces} of somebody"),
        ("", ""),
    ],
)
def test_what_the_core_composes_is_translated_in_parts(english: str, german: str) -> None:
    assert GERMAN.translated(english) == german
    assert texts_in("en").translated(english) == english


def test_a_very_long_text_stays_english() -> None:
    """A device may write it, and made for it, a text of some thousand characters would take minutes."""
    made = "5% of {} is missing, more than missing_limit (1%)"
    assert GERMAN.translated(made.format("i" * 100)) != made.format("i" * 100)
    assert GERMAN.translated(made.format("i" * 500)) == made.format("i" * 500)


@cache
def german_motor() -> LoadedMachine:
    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine.toml"
        path.write_text(text.replace("[machine]", '[machine]\nlanguage = "de"'), encoding="utf-8")
        return load_machine(path, with_driver=False)


@cache
def reports(scenario: str, count: int) -> list[ReportDocument]:
    machine = german_motor()
    state, documents = initial_state("m", "s", machine.problem, machine.plan), []
    ticks = simulate(load_scenario(EXAMPLES / "scenarios" / f"{scenario}.toml"))
    for index in range(count):
        rows = [[tick.measured[name] for name in SIGNALS.values()] for tick in islice(ticks, 200)]
        state, report = adapt(state, Window.whole(index, 2.0 * index, 0.01, tuple(SIGNALS), np.array(rows)))
        documents.append(ReportDocument.from_json(report.document.to_json()))
    return documents


def test_a_german_machine_has_german_events_and_states() -> None:
    last = reports("demo", 45)[-1]
    assert last.health is not None
    assert headline(last.health).startswith("HANDELN seit t = ")
    events = {event.part: event for event in last.events}
    assert events["winding"].condition_id == "winding-turns"
    assert event_text(events["winding"]).startswith("HANDELN: Wicklung: Windungsschluss in der Wicklung seit t = ")
    assert "Ankerwiderstand R_a ist 5." in events["winding"].text
    assert "unter dem Grenzwert 6.175 Ω" in events["winding"].text
    assert events["shaft"].text.startswith("neu: Drehmoment auf der Welle, ")
    assert last.health.parts["shaft"].reason == "Unwucht der Welle"
    assert last.health.parts["shaft"].state is Level.ACT  # what programs read is the same in all languages


def test_a_german_machine_has_german_sensor_faults() -> None:
    last = reports("sensor-frozen", 22)[-1]
    (event,) = last.events
    assert (event.condition_id, event.condition) == ("sensor", "ein Sensor misst falsch")
    assert event.text.startswith("Drehzahl des Rotors: omega steht das ganze Zeitfenster von ")
    assert " the " not in event_text(event)
    assert last.parameters["R_a"].reason.startswith(
        "aus dem Zeitfenster wird nichts geschätzt: omega steht das ganze Zeitfenster von "
    )


def words(text: str) -> set[str]:
    without_commands = re.sub(r"otolith (?:explain|components) [\w-]+", "", text)
    return set(re.findall(r"[^\W\d_]{2,}", without_commands))


def english_words() -> set[str]:
    """Words of the English texts, and of what the core composes, that are no German ones and no names of the twin."""
    english, twin = texts_in("en"), find_twin("dc_motor")
    texts = [*english.texts.values(), *english.conditions.values()]
    texts += [*(text for own in english.rules.values() for text in own.values())]
    german = [*GERMAN.texts.values(), *GERMAN.conditions.values()]
    german += [*(text for own in GERMAN.rules.values() for text in own.values())]
    names = [
        *twin.signals,
        *(row.name for row in twin.parameters),
        "dc_motor angle sin machine signals checks frozen spikes stale",
    ]
    sources = ["An Interpretable Digital Twin for Self-Aware Industrial Machines (2023), section", "Rotor balancing"]
    composed = [re.sub(r"{\w+}", "", text) for text in GERMAN.phrases]
    common = "the of and is with from to for not has no at by it its that be are was were if or this than other"
    known = words(" ".join([*german, *GERMAN.phrases.values(), *names, *sources]))
    return words(" ".join([*(re.sub(r"{\w+}", "", text) for text in texts), *composed, common])) - known


def names_in(view: object) -> Iterator[str]:
    """Yield what is above the views of a layout."""
    yield str(getattr(view, "name", None) or "")
    children = getattr(view, "contents", ())
    for child in children if isinstance(children, Iterable) and not isinstance(children, str) else ():
        yield from names_in(child)


def shown(documents: list[ReportDocument], folder: Path) -> dict[str, str]:
    """What people read of these reports: a page, the live table, and the texts of events and of a recording."""
    machine, last = german_motor(), documents[-1]
    writer = HistoryWriter(folder / f"m{SUFFIX}", Bounds(20_000_000, 3650, 24))
    numbers, _ = writer.open(documents[0].window.start)
    writer.description = describe_machine(machine.twin, machine.plan)
    counters = CountersDocument(received=9, lost=1, bad=1, windows_bad=1, worker_restarts=1, history_dropped=1)
    for document in documents:
        writer.add(numbers.number(document.model_copy(update={"counters": counters})))
    writer.stop(0.0)
    writer.write()
    now = last.window.end
    page = html_report(writer.reader, writer.reader.samples(WINDOW, 0.0), "window", 0.0, now)
    table, output = LiveTable(lambda: ""), io.StringIO()
    for document in documents:
        table.add(document.model_copy(update={"counters": counters}).to_json())
    Console(file=output, width=250).print(table)
    summary, replayed = ReplaySummary(), io.StringIO()
    for document in documents:
        summary.add(document)
    Console(file=replayed, width=250).print(summary)
    events = "\n".join(event_text(event) for document in documents for event in announcements(document))
    titles = re.findall(r'title="[^"]*"', page)
    body = re.sub(r"<style.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL)
    layout = list(names_in(blueprint(machine.recorded(Sampling.TRUE)).root_container))
    assert "Ereignisse" in layout
    recording = f"{operator_text(last)} {report_text(last)} {layout}"
    return {"page": f"{body} {titles}", "table": output.getvalue(), "events": events, "recording": recording,
            "replay": replayed.getvalue()}  # fmt: skip


@pytest.mark.parametrize(("scenario", "count"), [("demo", 45), ("sensor-frozen", 22), ("demo", 1)])
def test_no_english_word_is_left_in_what_a_german_operator_reads(scenario: str, count: int, tmp_path: Path) -> None:
    english = english_words()
    left = {name: words(text) & english for name, text in shown(reports(scenario, count), tmp_path).items()}
    assert not any(left.values()), left
