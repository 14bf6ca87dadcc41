"""What a report says, in the language of its reader: the same as if the machine had that language."""

from itertools import product

import pytest

from otolith.health.limits import Level
from otolith.health.schema import CrossingDocument, EventDocument, EvidenceDocument, Language
from otolith.health.text import crossing_text, event_in, interval_text, texts_in
from otolith_drivers.units import quantity_text

PAIRS: list[tuple[Language, Language]] = [("en", "de"), ("de", "en")]
VALUE = interval_text(5.9113, 0.004, "ohm")


def ahead(language: Language) -> list[str]:
    crossing = CrossingDocument(limit=6.1, at=13.0, low=11.0, high=15.0)
    rows = [crossing, crossing.model_copy(update={"high": None}), crossing.model_copy(update={"high": 11.0})]
    return [crossing_text(row, level, 0.0, language) for row, level in product(rows, ("WATCH", "ACT"))]


def sentences(language: Language) -> list[str]:
    """Sentences of events, in the same order in each language."""
    say = texts_in(language)
    what = {"what": say.translated("armature resistance"), "name": "R_a", "value": VALUE}
    limit, expected = quantity_text(6.175, "ohm"), ahead(language)
    besides = [say("beside", side=say(side), limit=limit) for side in ("below", "above", "still_near")]
    at = say("at_temperature", temperature="20")
    changes = ["", " (-9.1%)", f" (-9.1%{say('of_baseline')})", f" (-9.1%{say('of_baseline')}{at})", f" (-9.1%{at})"]
    warmings = ["", say("warming", kelvin="23"), say("cooled", kelvin="12")]
    coming = ["", *(f", {text}" for text in expected), f", {expected[0]}, {expected[1]}"]
    found = [say("limit", **what, beside=beside, change=change, expected=text, warming=warming)
             for beside, change, text, warming in product(besides, changes, coming, warmings)]  # fmt: skip
    component = {"what": say.translated("torque on the shaft"), "value": "4.655 ± 0.091 mN·m"}
    found += [say("component", **component, beside=beside) for beside in ("", *(f", {each}" for each in besides))]
    found += [say("colder", **what, limit=limit, kelvin="12"), say("moved", **what, change=changes[1], stated=limit)]
    found += [say("trend", **what, at=own, expected=text, limit=limit) for own, text in product(("", at), expected)]
    reason = say.translated("no window has determined it yet")
    found += [say("lost", **{**what, "value": value}, reason=reason) for value in (VALUE, say("unknown"))]
    found += [say("returns", count=4, duration="48 s"), say("class_in_words", count=3), say("not_yet", names="R_a, D")]
    return [*found, say("no_temperature", signal="T_w", name="R_a"), say("no_baseline"), say("changed")]


def test_a_signal_by_its_meaning_is_translated_with_what_is_said_of_it() -> None:
    said = "armature current: i is frozen at 3 A for 2 s (20 samples) from t = 4 s although the twin predicts changes"
    event = EventDocument(id="a", part="sensors", state=Level.ACT, start=0.0, since=0.0, condition="c", text=said,
                          evidence=EvidenceDocument(windows=(0, 1)))  # fmt: skip
    german = texts_in("de")
    subject, rest = (german.translated(part) for part in said.split(": "))
    assert event_in(event, "de").text == f"{subject}: {rest}"
    assert "armature" not in subject
    assert event_in(event.model_copy(update={"text": "R_a: 5"}), "de").text == "R_a: 5"


@pytest.mark.parametrize(("machine", "reader"), PAIRS)
def test_a_sentence_is_the_one_that_a_machine_with_the_language_of_the_reader_says(
    machine: Language, reader: Language
) -> None:
    event = EventDocument(id="a", part="winding", state=Level.ACT, start=0.0, since=0.0, condition="c", text="",
                          evidence=EvidenceDocument(windows=(0, 1)), language=machine)  # fmt: skip
    for own, other in zip(sentences(machine), sentences(reader), strict=True):
        assert event_in(event.model_copy(update={"text": own}), reader).text == other
