"""What a condition means to a person: a page for each rule of the diagnosis, in the language of its texts.

Cause and advice are those of the rule; what must be seen, what else it may be and when it clears follow from its keys.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from otolith.discovery.alternatives import COMPONENT_WINDOWS
from otolith.health.diagnosis import KEYS, LIMITS, Rule
from otolith.health.limits import Level
from otolith.health.observations import (
    INTERMITTENT_WINDOWS,
    MIN_RETURNS,
    PERSISTENCE,
    RELEASE_WINDOWS,
    Persistence,
)
from otolith.health.schema import FindingKind
from otolith.health.text import Texts
from otolith_drivers.grammars.markdown import markdown_text

MANY = 1000.0  # An order of this or more is no bound: the highest that rules have
OTHERS = {
    **dict.fromkeys((*LIMITS, FindingKind.TREND, FindingKind.MOVED), "other_value"),
    FindingKind.COMPONENT: "other_component",
    **dict.fromkeys((FindingKind.SENSOR, FindingKind.NOISE, FindingKind.TIMING), "other_signal"),
    **dict.fromkeys((FindingKind.UNEXPLAINED, FindingKind.RETURNS, FindingKind.CLASS), "other_operation"),
    **dict.fromkeys((FindingKind.NO_DATA, FindingKind.NO_SOURCE), "other_off"),
}
"""Key of what else may be the reason of a finding, beside the conditions that the data do not distinguish."""


@dataclass(frozen=True, slots=True)
class ConditionPage:
    """What a person has to know about one condition."""

    id: str
    condition: str
    texts: Mapping[str, str]  # Text by section: state, means, seen, do, stop, other, clears, source


def condition_page(rule: Rule, rules: Sequence[Rule], texts: Texts) -> ConditionPage:
    """Return the page of a worded rule among all ``rules`` of the machine, or among the packaged ones."""
    is_hint = rule.severity == "HINT" and rule.finding is not FindingKind.COMPONENT  # whose amplitude may have limits
    stop, clears = rule.stop or ("no" if is_hint else "state"), "hint" if is_hint else _key(rule.finding)
    sections = {
        "state": _state(rule, texts),
        "means": rule.cause,
        "seen": " ".join(_seen(rule, texts)),
        "do": rule.advice,
        "stop": texts.conditions[f"stop_{stop}"],
        "other": " ".join(_other(rule, rules, texts)),
        "clears": texts.conditions[f"clears_{clears}"].format(**_numbers(rule)),
    }
    written = {key: texts.decimals(text) for key, text in sections.items() if text}
    return ConditionPage(rule.id, rule.condition, {**written, "source": rule.source})


def pages_of(condition_ids: Iterable[str], rules: Sequence[Rule], texts: Texts) -> list[ConditionPage]:
    """Return the page of each condition that events name, once; ids that no rule has are left out."""
    known = {rule.id: rule for rule in reversed(rules)}  # of equal ids that of the machine, which comes first
    names = (name for text in condition_ids for name in ([text] if text in known else text.split(" ")))
    return [condition_page(known[name], rules, texts) for name in dict.fromkeys(names) if name in known]


def markdown(pages: Iterable[ConditionPage], texts: Texts) -> str:
    """Return the pages as one file with an anchor for each condition, by its id."""
    own = texts.conditions
    lines = [f"# {own['title']}", "", own["about"], ""]
    for page in pages:
        lines += [f"## {_line(page.id)}", "", f"**{_line(page.condition)}**", "", "| | |", "|---|---|"]
        lines += [f"| {own[key]} | {_line(text)} |" for key, text in page.texts.items()]
        lines.append("")
    return "\n".join(lines)


def _line(text: str) -> str:
    """Return a text of a rule, which may have several lines in a machine file, as one of Markdown."""
    return markdown_text(" ".join(text.splitlines()))


def _key(kind: FindingKind) -> str:
    return kind.replace(" ", "_")


def _numbers(rule: Rule) -> dict[str, int]:
    own = PERSISTENCE.get(rule.finding, Persistence())
    return {
        "rise": own.rise,
        "fall": own.fall,
        "within": own.within or own.rise,
        "component": COMPONENT_WINDOWS,
        "release": RELEASE_WINDOWS,
        "returns": MIN_RETURNS,
        "intermittent": INTERMITTENT_WINDOWS,
    }


def _state(rule: Rule, texts: Texts) -> str:
    if rule.finding in LIMITS and rule.severity != "HINT":
        return texts.conditions["state_limit"]
    if rule.finding in (FindingKind.NO_DATA, FindingKind.NO_SOURCE):
        return texts.conditions[f"state_{_key(rule.finding)}"]
    level = texts.translated(Level(rule.severity))
    return texts.conditions["state_component"].format(level=level) if rule.finding is FindingKind.COMPONENT else level


def _seen(rule: Rule, texts: Texts) -> Iterable[str]:
    """Yield what must be seen, a sentence each: the finding, then the keys of the rule."""
    own, is_place = texts.conditions, rule.finding is FindingKind.COMPONENT
    yield own[f"seen_{_key(rule.finding)}"].format(**_numbers(rule))
    if rule.subject:
        names = map(texts.translated, rule.subject) if is_place else rule.subject
        yield own["place" if is_place else "subject"].format(names=", ".join(names))
    if len(rule.side) == 1:
        yield own[f"{'delay' if rule.finding is FindingKind.TIMING else 'side'}_{rule.side[0]}"]
    for manner in rule.manner:
        yield own[f"manner_{manner.replace(' ', '_')}"]
    if rule.family:
        yield own["family"].format(names=", ".join(map(texts.translated, rule.family)))
    if rule.input:
        yield own["input"].format(names=", ".join(own.get(f"input_{name}", name) for name in rule.input))
    if rule.order is not None:
        low, high = rule.order
        yield own["order_from" if high >= MANY else "order"].format(low=f"{low:g}", high=f"{high:g}")
    if rule.twin:
        yield own["twin"].format(names=", ".join(rule.twin))


def _other(rule: Rule, rules: Iterable[Rule], texts: Texts) -> Iterable[str]:
    """Yield what else it may be: conditions with the same keys, and what is no fault."""
    same = [other for other in rules if other.id != rule.id and _keys(other) == _keys(rule)]
    if same:
        names = texts("alternatives").join(f"{other.condition} ({other.id})" for other in same)
        yield texts.conditions["other_rules"].format(names=names)
    if rule.severity != "HINT" and (key := OTHERS.get(rule.finding)):
        yield texts.conditions[key]


def _keys(rule: Rule) -> tuple[object, ...]:
    return (rule.is_own, rule.finding, rule.order, *(getattr(rule, key) for key in KEYS))
