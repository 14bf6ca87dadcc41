"""The pages of conditions: each rule has a whole one in each language, also the rules of a machine file."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from otolith.cli.main import cli
from otolith.health.conditions import condition_page, markdown, pages_of
from otolith.health.diagnosis import Rule
from otolith.health.limits import Level
from otolith.health.schema import LANGUAGES, EventChange, FindingKind, HealthDocument, Language
from otolith.health.text import texts_in
from otolith.machine import find_twin, load_rules
from otolith.storage.history import describe_machine, history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.outside_text import CONTROL
from tests.cli.commands import otolith
from tests.health.test_events import PLAN
from tests.hostile import HOSTILE
from tests.messages import assert_says, raises_saying
from tests.storage.histories import MACHINE, SITE, document, event

DOCS = Path(__file__).parents[2] / "docs"
SECTIONS = {"state", "means", "seen", "do", "stop", "clears", "source"}
OWN = Rule(
    id="worn-seal <b>", finding=FindingKind.LIMIT, subject=("R_a",), side=("below",), condition="worn piston seal",
    cause="particles in the oil", advice="replace the seal kit", source="the machine file", stop="soon", is_own=True,
)  # fmt: skip


@pytest.mark.parametrize("language", LANGUAGES)
def test_each_rule_has_a_whole_page_and_the_docs_are_current(language: Language) -> None:
    rules, texts = load_rules(language), texts_in(language)
    pages = [condition_page(rule, rules, texts) for rule in rules]
    for page in pages:
        assert page.texts.keys() >= SECTIONS, page.id
        assert not [text for text in page.texts.values() if "{" in text], page.id
    name = "conditions.md" if language == "en" else f"conditions.{language}.md"
    assert (DOCS / name).read_text(encoding="utf-8") == markdown(pages, texts), f"make conditions writes {name}"


def test_only_a_signal_is_early_or_late() -> None:
    rules = load_rules()
    seen = {page.id: page.texts["seen"] for page in pages_of([rule.id for rule in rules], rules, texts_in("en"))}
    assert "The signal is early." in seen["early-signal"]
    assert [name for name, text in seen.items() if "nominal value" in text and "signal is" in text] == []


def test_what_the_data_do_not_distinguish_names_each_other() -> None:
    rules = load_rules()
    pages = {page.id: page for page in pages_of([rule.id for rule in rules], rules, texts_in("en"))}
    assert_says(pages["winding-hot"].texts["other"], "winding-contact")
    assert_says(pages["winding-contact"].texts["other"], "winding-hot")
    assert "winding" not in pages["unbalance"].texts["other"]


def test_advice_to_stop_and_the_answer_to_it_agree() -> None:
    for rule in load_rules():
        says_now, says_soon = "stop the machine" in rule.advice, "stop at the next" in rule.advice
        assert not says_now or rule.stop == "now", rule.id
        assert not says_soon or rule.stop == "soon", rule.id


def test_a_hint_that_a_limit_may_raise_says_what_to_do_then() -> None:
    texts = texts_in("en")
    rule = OWN.model_copy(update={"finding": FindingKind.COMPONENT, "severity": "HINT", "stop": ""})
    assert condition_page(rule, [rule], texts).texts["stop"] == texts.conditions["stop_state"]


def test_an_event_of_several_conditions_has_the_page_of_each() -> None:
    rules, texts = (OWN, *load_rules()), texts_in("en")
    pages = pages_of(["winding-hot winding-contact", OWN.id, "winding-hot", "gone"], rules, texts)
    assert [page.id for page in pages] == ["winding-hot", "winding-contact", OWN.id]
    assert pages[-1].texts["stop"] == texts.conditions["stop_soon"]


def test_the_command_explains_and_lists() -> None:
    assert_says(otolith("explain", "unbalance").output, "balance the rotor", "0.95 to")
    assert_says(otolith("explain", "unbalance", "--language", "de").output, "auswuchten")
    listed = otolith("explain").output.splitlines()
    assert [line.split()[0] for line in listed] == [rule.id for rule in load_rules()]
    (page,) = json.loads(otolith("explain", "unbalance", "--json").output)["conditions"]
    assert page.keys() >= SECTIONS | {"id", "condition"}
    with raises_saying(ConfigurationError, "unbalence", "unbalance"):
        otolith("explain", "unbalence")


@pytest.mark.parametrize("given", ["", "name", "file"])
def test_a_condition_is_explained_in_the_language_of_the_machine(given: str, tmp_path: Path) -> None:
    """Its events name the command without an option, and nobody translates for the night shift."""
    file = tmp_path / "machine.toml"
    file.write_text('[machine]\nname = "new"\nlanguage = "de"\n[twin]\nname = "dc_motor"\n', encoding="utf-8")
    if given != "file":
        monitored(OWN, "de")
    machine = {"": (), "name": ("--machine", MACHINE), "file": ("--machine", str(file))}[given]
    assert_says(otolith("explain", "unbalance", *machine).output, "auswuchten")
    assert_says(otolith("explain", "unbalance", *machine, "--language", "en").output, "balance the rotor")


def monitored(own: Rule, language: Language = "en") -> None:
    """Write a history of a machine whose file has a rule, and with one event of it."""
    end = 1_700_000_000.0
    plan = replace(PLAN, rules=(own, *PLAN.rules))
    writer = HistoryWriter(history_path(SITE, MACHINE), Bounds(20_000_000, 3650, 24))
    numbers, _ = writer.open(end)
    raised = event(50, end, EventChange.RAISED).model_copy(update={"condition_id": own.id})
    writer.description = describe_machine(find_twin("dc_motor"), plan)
    health = HealthDocument(state=Level.OK, since=end, parts={}, language=language)
    writer.add(numbers.number(document(50, end).model_copy(update={"events": (raised,), "health": health})))
    writer._write_waiting()
    writer._close()


def test_rules_of_a_machine_file_are_explained_in_terminal_and_page() -> None:
    monitored(OWN)
    assert_says(otolith("explain", OWN.id).output, "particles in the oil", "replace the seal kit", "next opportunity")
    page = CliRunner().invoke(cli, ["report", MACHINE, "--since", "9000d", "--output", "-"]).output
    assert_says(page, "particles in the oil", 'href="#condition-0"', 'id="condition-0"')
    assert "<b>worn" not in page
    assert "worn-seal <b>" not in page


def test_text_of_a_rule_is_no_markdown() -> None:
    text = r"a <b>x</b> &lt;i> | c\| `d` [e](javascript:f)"
    rule = OWN.model_copy(update=dict.fromkeys(("id", "condition", "cause", "advice", "source"), text))
    texts = texts_in("en")
    written = markdown([condition_page(rule, [rule], texts)], texts)
    assert written.count(r"a \<b\>x\</b\> \&lt;i\> \| c\\\| \`d\` \[e\](javascript:f)") == 5


def test_a_rule_of_any_history_controls_no_terminal_and_makes_no_line() -> None:
    attacks = " ".join(text for text in HOSTILE if len(text) < 100)
    monitored(OWN.model_copy(update=dict.fromkeys(("condition", "cause", "advice"), attacks)))
    markdown_page = ("explain", "--machine", MACHINE, "--markdown")
    written = otolith(*markdown_page).stdout
    monitored(OWN)
    assert written.count("\n") == otolith(*markdown_page).stdout.count("\n")
    assert not CONTROL.search(written.replace("\n", ""))
