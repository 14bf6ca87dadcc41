"""The texts: every language has the same texts, and what people read is in the language of the machine."""

import re
import tomllib
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health import language as module
from otolith.health.language import LANGUAGES, Language, texts_in
from otolith.health.limits import MACHINE, Level
from otolith.health.observations import BUS, SENSORS
from otolith.health.schema import ReportDocument
from otolith.health.text import event_text, headline
from otolith.machine import find_twin, library_twins, load_machine, load_rules
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.conftest import EXAMPLES, SIGNALS, OwnMachine

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
        assert set(tomllib.loads(path.read_text(encoding="utf-8"))) <= {"texts", "rules", "phrases"}


@pytest.mark.parametrize("language", OTHERS)
def test_what_the_library_and_the_states_name_is_translated(language: Language) -> None:
    twins = [find_twin(name) for name in library_twins()]
    words = {MACHINE, BUS, SENSORS} | {str(level) for level in Level} - {"OK"}
    for twin in twins:
        words |= {parameter.meaning for parameter in twin.parameters} | {site.meaning for site in twin.sites}
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
            "a sensor is wrong: V reads -0.3% off: look at the sensor and its scale (20%); or K_e (1%)",
            "ein Sensor misst falsch: V zeigt um -0.3% falsch an: Sensor und Skalierung prüfen (20 %); oder K_e (1 %)",
        ),
        (
            "i is frozen at 3 A for 2 s (20 samples) from t = 4 s while the twin moves on: look at the sensor",
            "i steht seit t = 4 s für 2 s (20 Messwerte) auf 3 A fest, während der Zwilling sich bewegt: Sensor prüfen",
        ),
        (
            "without x in checks of i in [signals], as in checks = [], it counts as measured; 3 records are too few",
            "ohne x in checks von i in [signals], wie in checks = [], gilt es als gemessen; 3 Datensätze sind zu wenig",
        ),
        (
            "a step of V_a from 3 to 5 V would decide if the other inputs stay as they are",
            "ein Sprung von V_a von 3 auf 5 V würde entscheiden, wenn die anderen Eingangsgrößen bleiben, wie sie sind",
        ),
        (
            "a signal is late: i is 5 ms late (4 to 6): write delay = 5 under [signals] i (9%)",
            "ein Signal kommt verspätet: i kommt 5 ms zu spät (4 bis 6): delay = 5 eintragen unter [signals] i (9 %)",
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


def reports(own_machine: OwnMachine, scenario: str, count: int) -> list[ReportDocument]:
    text = own_machine.machine.read_text(encoding="utf-8")
    own_machine.machine.write_text(text.replace("[machine]", '[machine]\nlanguage = "de"'), encoding="utf-8")
    machine = load_machine(own_machine.machine, with_driver=False)
    state, documents = initial_state("m", "s", machine.problem, machine.plan), []
    ticks = simulate(load_scenario(EXAMPLES / "scenarios" / f"{scenario}.toml"))
    for index in range(count):
        rows = [[tick.measured[name] for name in SIGNALS.values()] for tick in islice(ticks, 200)]
        state, report = adapt(state, Window.whole(index, 2.0 * index, 0.01, tuple(SIGNALS), np.array(rows)))
        documents.append(ReportDocument.from_json(report.document.to_json()))
    return documents


def test_a_german_machine_has_german_events_and_states(own_machine: OwnMachine) -> None:
    last = reports(own_machine, "demo", 45)[-1]
    assert last.health is not None
    assert headline(last.health).startswith("HANDELN seit t = ")
    events = {event.part: event for event in last.events}
    assert events["winding"].condition_id == "winding-turns"
    assert event_text(events["winding"]).startswith("HANDELN: Wicklung: Windungsschluss in der Wicklung seit t = ")
    assert "Ankerwiderstand R_a ist 5." in events["winding"].text
    assert "unter dem Grenzwert 6.175 ohm" in events["winding"].text
    assert events["shaft"].text.startswith("neu: Drehmoment auf der Welle ")
    assert last.health.parts["shaft"].reason == "Unwucht der Welle"
    assert last.health.parts["shaft"].state is Level.ACT  # what programs read is the same in all languages


def test_a_german_machine_has_german_sensor_faults(own_machine: OwnMachine) -> None:
    last = reports(own_machine, "sensor-frozen", 22)[-1]
    (event,) = last.events
    assert (event.condition_id, event.condition) == ("sensor", "ein Sensor misst falsch")
    assert event.text.startswith("omega steht seit ")
    assert " the " not in event_text(event)
    assert last.parameters["R_a"].reason.startswith("aus dem Zeitfenster wird nichts geschätzt: omega steht seit ")
