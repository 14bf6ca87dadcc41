"""A report in words. Every text that shows a value, a component or a finding to a person is made here.

Texts are in the language of a machine, from ``texts/en.toml`` and the like. Rules and texts have a key. What the core,
the twins and the drivers compose in English is translated by ``[phrases]``: a phrase is an English sentence with names
in braces, and a sentence that it matches becomes its translation, with the parts translated too. What no phrase matches
stays English.
"""

import re
import shlex
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.decision import Approval
from otolith.estimation.information import QUANTILE
from otolith.health.limits import MACHINE, Level
from otolith.health.schema import (
    ComponentDocument,
    CrossingDocument,
    EventChange,
    EventDocument,
    FindingDocument,
    FindingKind,
    HealthDocument,
    HeldDocument,
    Language,
    NoteDocument,
    ParameterDocument,
    PartDocument,
    PerformanceDocument,
    ReportDocument,
    RequirementDocument,
    Status,
)
from otolith.health.times import Clock, clock_in, expected_text, in_local_time
from otolith_drivers.units import equation_text, quantity_text, scale_of, unit_text

UNKNOWN = "unknown"
UNDECIDED = (FindingKind.OPEN, FindingKind.CLASS)  # Findings of which it is open what causes them
ALTERNATIVES = "; or "  # between the parts of a sentence, as the next
PARTS = "; "
LINE = 100  # characters that fit into a log beside its time; engineering choice
MAX_SENTENCE = 500  # characters: the time of a match grows with a high power of them, and a device may write the text
QUOTED = re.compile(r'("[^"\n]*"|`[^`\n]*`)')  # lines for a file, which has points in each language
DECIMAL = re.compile(r"(?<![\w.,:/])(?<![\w.,:/][-+])(\d+)\.(\d+)(?!\d|[.:/])")
"""A number with a decimal point. A date, an address and the number of a version have more points, or signs beside."""
UNITS_OF_TIME = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))
"""Length in s and name, the longest first; a duration is given in the longest of which it has at least two."""


@dataclass(frozen=True, slots=True)
class Texts:
    """The texts of a language."""

    language: Language
    rules: dict[str, dict[str, str]]  # Condition, cause and advice of each rule, by its id
    texts: dict[str, str]  # By key, with names in braces
    conditions: dict[str, str]  # Of the pages of conditions, by key, with names in braces
    phrases: dict[str, str]  # Translations by the English phrase; empty for English
    patterns: tuple[tuple[re.Pattern[str], str], ...]  # The phrases with names in braces; the first that matches counts

    def __call__(self, key: str, **values: object) -> str:
        """Return the text of ``key`` with its values."""
        return self.texts[key].format(**values)

    def part(self, name: str) -> str:
        """Return the name of a part for people; the whole machine without one."""
        return self.texts["other_part"] if name == MACHINE else self.translated(name) or self.texts["whole_machine"]

    def decimals(self, text: str) -> str:
        """Return a text in this language with the decimal sign of this language, but for what is in quotation marks."""
        sign = self.texts["decimal_sign"]
        if sign == "." or "." not in text:
            return text
        parts = QUOTED.split(text)
        parts[::2] = (DECIMAL.sub(rf"\1{sign}\2", part) for part in parts[::2])
        return "".join(parts)

    def translated(self, text: str) -> str:
        """Return an English text in this language; what no phrase matches stays English."""
        if not self.phrases or not text:
            return text
        if (whole := self.phrases.get(text)) is not None:
            return whole
        for joint, own in ((ALTERNATIVES, self.texts["alternatives"]), (PARTS, PARTS)):
            if joint in text:
                return own.join(map(self.translated, text.split(joint)))
        if len(text) > MAX_SENTENCE:
            return text
        for pattern, translation in self.patterns:
            if match := pattern.fullmatch(text):
                return translation.format(**{name: self.translated(part) for name, part in match.groupdict().items()})
        return text


@lru_cache
def texts_in(language: Language) -> Texts:
    """Return the texts of a language."""
    content = tomllib.loads(files("otolith.health").joinpath("texts", f"{language}.toml").read_text(encoding="utf-8"))
    phrases: dict[str, str] = content.get("phrases", {})
    patterns = tuple((_pattern(phrase), text) for phrase, text in phrases.items() if "{" in phrase)
    return Texts(language, content["rules"], content["texts"], content["conditions"], phrases, patterns)


def _pattern(phrase: str) -> re.Pattern[str]:
    """Return the expression of a phrase: each name in braces is any text, and ``share`` is a number."""
    expression = re.sub(r"\\{(\w+)\\}", r"(?P<\1>.*?)", re.escape(phrase)).replace("<share>.*?", r"<share>[<>]?[\d.]+")
    return re.compile(expression, re.DOTALL)


SENTENCES = ("not_served", "colder", "trend", "moved", "limit", "component", "returns", "lost",
             "changed", "not_yet", "no_longer", "no_baseline", "no_temperature", "class_in_words")  # fmt: skip
"""Texts of reports, by which a sentence in one language becomes one in another."""
INNER = {"side": ("below", "above", "still_near"), "beside": ("beside",), "change": ("of_baseline", "at_temperature"),
         "at": ("at_temperature",), "expected": ("reaches_between", "reaches_after", "reaches", "cooled"),
         "warming": ("warming",), "value": ("unknown", "at_temperature")}  # fmt: skip
"""The texts that are parts of these, by their names in braces."""
SHAPES = {"what": ".{1,80}?", "name": r"\S{1,64}", "value": "[^:,;()]+", "change": r"(?: \(.*?\))?",
          "beside": "(?:(?:, )?[^,;()]+)?", "expected": "[^;]*", "warming": "(?:; .*)?", "at": "(?: .*?)?"}  # fmt: skip
"""What stands for a name in braces; any text for the others."""


def report_in(report: ReportDocument, language: Language | None, zone: str | None = None) -> ReportDocument:
    """Return a report in the language and zone of its reader, by default in those of the machine.

    The texts of rules of the machine file stay in the language of the machine.
    """
    if (health := report.health) is None:
        return report
    language = language or health.language
    source, target = texts_in(health.language), texts_in(language)
    events = tuple(event_in(event, language, zone) for event in report.events)
    known = {old.condition: new.condition for old, new in zip(report.events, events, strict=True)}

    def reworded(text: str) -> str:
        return known.get(text) or PARTS.join(known.get(part) or _reworded(part, source, target)
                                             for part in text.split(PARTS))  # fmt: skip

    parts = {name: part.model_copy(update={"reason": reworded(part.reason)}) for name, part in health.parts.items()}
    own = {"language": language, "timezone": zone or health.timezone, "reason": reworded(health.reason), "parts": parts}
    findings = tuple(row.model_copy(update={"condition": reworded(row.condition)}) for row in report.findings)
    return report.model_copy(update={"events": events, "findings": findings, "health": health.model_copy(update=own)})


def event_in(event: EventDocument, language: Language | None, zone: str | None = None) -> EventDocument:
    """Return an event in the language of its reader; see :func:`report_in`."""
    language = language or event.language
    source, target = texts_in(event.language), texts_in(language)
    own: dict[str, str] = {} if zone is None else {"timezone": zone}
    if source is not target:
        own["language"] = language
        own |= {key: _reworded(getattr(event, key), source, target) for key in ("text", "setting", "condition")}
        rows = [target.rules[key] for key in event.condition_id.split() if key in target.rules]
        if rows and len(rows) == len(event.condition_id.split()):
            joints = {"condition": target("or"), "cause": target("alternatives"), "advice": PARTS}
            own |= {key: joint.join(dict.fromkeys(row[key] for row in rows)) for key, joint in joints.items()}
    return event.model_copy(update=own)


def _reworded(text: str, source: Texts, target: Texts) -> str:
    """Return a sentence of a report in another language, as far as it is known there."""
    if source is target or len(text) > MAX_SENTENCE:
        return target.translated(text)
    return _sentence_in(text, source.language, target.language)


@lru_cache(maxsize=4096)
def _sentence_in(text: str, from_language: Language, to_language: Language) -> str:
    source, target = texts_in(from_language), texts_in(to_language)
    for key in SENTENCES:
        if match := _sentence(source.texts[key]).fullmatch(text):
            return target(key, **{name: _part(name, part, source, target) for name, part in match.groupdict().items()})
    subject, colon, rest = text.partition(": ")
    if colon and (own := _known_word(subject, source, target)) != subject:  # a signal by its meaning
        return f"{own}: {_known_word(rest, source, target)}"
    return _known_word(text, source, target)


@lru_cache
def _sentence(template: str) -> re.Pattern[str]:
    """Return the expression of a whole sentence."""

    def shape(name: re.Match[str]) -> str:
        return f"(?P<{name[1]}>{SHAPES.get(name[1], '.*?')})"

    return re.compile(re.sub(r"\\{(\w+)\\}", shape, re.escape(template)), re.DOTALL)


def _part(name: str, text: str, source: Texts, target: Texts) -> str:
    """Return a part of a sentence in another language: its words become others, and its numbers stay."""
    if name in ("what", "reason", "level"):
        return _known_word(text, source, target)
    for key in INNER.get(name, ()):

        def own(match: re.Match[str], key: str = key) -> str:
            return target(key, **{name: _part(name, part, source, target) for name, part in match.groupdict().items()})

        text = _inner(source.texts[key]).sub(own, text)
    return text


@lru_cache
def _inner(template: str) -> re.Pattern[str]:
    """Return the expression of a part within a longer one: a name in braces ends at a comma, semicolon or bracket."""
    end = "(?![^,;()])" if "{" in template else ""
    return re.compile(re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^,;()]*?)", re.escape(template)) + end)


def _known_word(text: str, source: Texts, target: Texts) -> str:
    """Return a phrase in another language."""
    english = next((own for own, phrase in source.phrases.items() if phrase == text and "{" not in own), text)
    return target.translated(english)


def interval_text(value: float, sd: float, unit: str) -> str:
    """A value with its 95 % interval: ``5.9856 ± 0.0075 Ω``; ``sd`` is its standard deviation."""
    return quantity_text(value, unit, QUANTILE * sd)


def value_text(parameter: ParameterDocument) -> str:
    """The value of a parameter with its 95 % interval, or ``unknown``."""
    if parameter.value is None or parameter.sd is None:
        return UNKNOWN
    return interval_text(parameter.value, parameter.sd, parameter.unit)


def value_cells(parameter: ParameterDocument) -> tuple[str, str, str, str]:
    """The cells of a parameter in a table: value, half of the 95 % interval, unit, change.

    The change is that against the baseline, or else the nominal value; empty if that is of another machine.
    """
    if parameter.value is None or parameter.sd is None:
        return UNKNOWN, "", unit_text(parameter.unit), ""
    healthy = parameter.nominal if parameter.baseline is None else parameter.baseline
    change = f"{parameter.value / healthy - 1:+.2%}" if healthy and not parameter.is_example else ""
    change = "0.00%" if change in ("-0.00%", "+0.00%") else change
    half = QUANTILE * parameter.sd
    scale = scale_of(parameter.value, parameter.unit, half)
    return *scale.numbers(parameter.value, half), scale.unit, change


def only_as_right_as(held: Mapping[str, HeldDocument]) -> str:
    """With which held values an estimate is right or wrong; empty without any."""
    texts = [f"{name} = {quantity_text(item.value, item.unit)}" for name, item in held.items()]
    return f"only as right as what is held: {', '.join(texts)}" if texts else ""


def parameter_text(name: str, parameter: ParameterDocument) -> str:
    """Name, value and interval of a parameter, with status and reason unless this window estimated it."""
    text = f"{name} {value_text(parameter)}"
    if parameter.status is Status.ESTIMATED:
        return text
    return f"{text} ({parameter.status}: {parameter.reason})"


def performance_texts(item: PerformanceDocument, texts: Texts, zone: str | None = None) -> list[str]:
    """A figure of performance in sentences: its value, against that of the healthy machine, and at a limit.

    Also whether these are as required, and until when; ``zone`` is that of the plant.
    """
    if item.value is None or item.sd is None:
        return [texts("no_figure", reason=texts.translated(item.reason))]
    required = item.requirement
    lines = [interval_text(item.value, item.sd, item.unit)]
    if item.status is not Status.ESTIMATED:
        lines[0] += f" ({texts.translated(item.status)}: {texts.translated(item.reason)})"
    if item.baseline is not None:
        is_same = abs(item.value - item.baseline) <= QUANTILE * item.sd
        key = "as_healthy" if is_same else "more_than_healthy" if item.value > item.baseline else "less_than_healthy"
        healthy = quantity_text(item.baseline, item.unit)
        share = f"{abs(item.value / item.baseline - 1.0):.0%}".replace("%", " %") if item.baseline else ""
        text = texts(key, share=share, healthy=healthy).strip()
        lines.append(text + (_as_required(required.met_at_baseline, texts) if required else ""))
    if item.at_limit is not None and item.limit is not None:
        limit, value = quantity_text(item.limit, item.limit_unit or "1"), quantity_text(item.at_limit, item.unit)
        text = texts("figure_at_limit", name=item.limited, limit=limit, value=value)
        lines.append(text + (_as_required(required.met_at_limit, texts) if required else ""))
    if required is not None:
        lines.append(_required_text(required, item.unit, texts, zone))
    return lines


def _as_required(is_met: bool | None, texts: Texts) -> str:
    return "" if is_met is None else texts("as_required" if is_met else "not_as_required")


def _required_text(item: RequirementDocument, unit: str, texts: Texts, zone: str | None) -> str:
    """Whether a figure has its required value, until when, or else as long as which parameters are inside."""
    key = "met_open" if item.met is None else "met" if item.met else "not_met"
    text = texts(key, required=quantity_text(item.value, unit))
    if (lacks := item.lacks) is not None:
        spread = (lacks.at if lacks.high is None else lacks.high) - lacks.low
        low, at = expected_text(lacks.low, spread, zone), expected_text(lacks.at, spread, zone)
        high = texts("later") if lacks.high is None else expected_text(lacks.high, spread, zone)
        limit = quantity_text(lacks.limit, lacks.unit)
        return text + texts("no_longer_met", name=lacks.parameter, limit=limit, at=at, low=low, high=high)
    inside = [
        texts(key, name=name, limit=quantity_text(end, row.unit))
        for name, row in (item.kept or {}).items()
        for key, end in (("from_limit", row.low), ("up_to_limit", row.high))
        if end is not None
    ]
    return text + texts("met_while", inside=", ".join(inside)) if inside else text


def component_text(component: ComponentDocument, texts: Texts) -> str:
    """Site, equation and approval of a component that the twin lacks."""
    return f"{component.meaning}: {equation_text(component.equation)} ({approval_text(component, texts)})"


def approval_text(component: ComponentDocument, texts: Texts) -> str:
    """What the operator decided about a component."""
    is_open = component.approval is Approval.OPEN
    return texts("not_approved") if is_open else texts.translated(component.approval)


def finding_text(finding: FindingDocument) -> str:
    """Severity, text and advice of a finding."""
    return "; ".join(filter(None, [f"{finding.severity}: {finding.text}", finding.advice, finding.setting]))


def event_text(event: EventDocument, when: Clock | None = None, *, details: bool = False) -> str:
    """State, part, condition, begin, values, certainty and advice; ``when`` gives the times, by default of the plant.

    With ``details`` also what to write into the machine file, as the specialist reads it, and the command that explains
    the condition.
    """
    # Before the sentence is made: it also has the words of persons, whose times stay as they wrote them.
    own = {"text": event.text, "reason": event.reason}
    update = {key: in_local_time(text, event.timezone) for key, text in own.items() if text}
    sentence = _event_sentence(event.model_copy(update=update), when or clock_in(event.timezone), details=details)
    return texts_in(event.language).decimals(sentence)


def _event_sentence(event: EventDocument, when: Clock, *, details: bool) -> str:
    texts = texts_in(event.language)
    part, condition = texts.part(event.part), event.condition
    if event.change is EventChange.NOTED:
        return texts("noted", part=part, text=event.text, time=when(event.start))
    notes = "".join(f"{PARTS}{note}" for note in note_texts(event, when))
    if event.end is not None:
        line = texts("cleared", part=part, condition=condition, start=when(event.start), end=when(event.end))
        return f"{line}; {texts('dropped', reason=event.reason)}{notes}" if event.reason else f"{line}{notes}"
    sure = f" ({probability})" if (probability := probability_text(event)) else ""
    more = (event.formulas, event.setting, explain_command(event)) if details else ()
    advice = "".join(f"; {text}" for text in (event.advice, *more) if text)
    state, since = texts.translated(event.state), when(event.since)
    values = {"state": state, "part": part, "condition": condition, "since": since, "text": event.text}
    return f"{texts('event', **values, sure=sure, advice=advice)}{notes}"


def event_lines(event: EventDocument) -> list[str]:
    """An open event for the specialist, a line each: what since when, values, notes, what to do, what explains it."""
    texts, when = texts_in(event.language), clock_in(event.timezone)
    what = f"{texts.translated(event.state)}: {texts.part(event.part)}: {event.condition}"
    sure = f" ({probability})" if (probability := probability_text(event)) else ""
    advice = f"{texts('what_to_do')}: {event.advice}" if event.advice else ""
    lines = [f"{what} {texts('since', time=when(event.since))}", f"{in_local_time(event.text, event.timezone)}{sure}"]
    lines += [*note_texts(event, when), advice, event.formulas, event.setting, explain_command(event)]
    return [texts.decimals(line) for line in lines if line]


def explain_command(event: EventDocument) -> str:
    """Return the command that explains the conditions of an event without a network; empty if no rule has them."""
    return shlex.join(["otolith", "explain", *event.condition_id.split()]) if event.condition_id else ""


def note_texts(event: EventDocument, when: Clock) -> list[str]:
    """What persons did with an event, a sentence each: until when it is shelved, who has seen it, and comments.

    Their words are in quotation marks, in which nothing is translated.
    """
    texts = texts_in(event.language)

    def sentence(key: str, note: NoteDocument) -> str:
        until = "" if note.until is None else when(note.until)
        words = note.text.replace('"', "'")
        text = f': "{words}"' if words else ""
        return texts(key, time=when(note.at), until=until, by=note.by, text=text)

    notes = [("shelved", event.shelved), ("acknowledged", event.acknowledged)]
    notes += [("comment", note) for note in event.comments or ()]
    return [sentence(key, note) for key, note in notes if note is not None]


def probability_text(event: EventDocument) -> str:
    """How sure it is that the limit is passed; empty if the event has none, or its value is back inside."""
    if (probability := event.evidence.probability) is None or probability < 0.5:
        return ""
    texts = texts_in(event.language)
    return texts("nearly_sure") if probability > 0.999 else texts("probability", share=f"{100.0 * probability:.3g}")


def duration_text(seconds: float) -> str:
    """A duration with two digits: ``3.4 h``."""
    length, unit = next(((length, unit) for length, unit in UNITS_OF_TIME if seconds >= 2.0 * length), (1.0, "s"))
    number = max(seconds, 0.0) / length
    return f"{number:.0f} {unit}" if number >= 10.0 else f"{number:.2g} {unit}"


def crossing_text(crossing: CrossingDocument, level: str, now: float, language: Language = "en") -> str:
    """When a limit is passed, from ``now`` in Unix s: ``reaches ACT in 3.1 h to 5 h``."""
    texts, low = texts_in(language), duration_text(crossing.low - now)
    level = texts.translated(level)
    if crossing.high is None:
        return texts("reaches_after", level=level, low=low)
    high = duration_text(crossing.high - now)
    return texts("reaches" if low == high else "reaches_between", level=level, low=low, high=high)


def forecast_text(parameter: ParameterDocument, now: float, language: Language = "en") -> str:
    """When a parameter passes its limits, from ``now`` in Unix s; empty without a forecast of the time after it."""
    if (forecast := parameter.forecast) is None:
        return ""
    levels = (("WATCH", forecast.watch), ("ACT", forecast.act))
    return ", ".join(
        crossing_text(crossing, level, now, language)
        for level, crossing in levels
        if crossing is not None and crossing.at > now
    )


def announcements(document: ReportDocument) -> list[EventDocument]:
    """The events that the window raised, changed or cleared."""
    return [event for event in document.events if event.change is not None]


def headline(health: HealthDocument, when: Clock | None = None, events: Collection[EventDocument] = ()) -> str:
    """State of the machine, since when, and which parts are in it and why; also what is not known beside that.

    Reasons that several parts share are given once. Those of ``events``, which have lines of their own, are left out.
    """
    texts, told = texts_in(health.language), {event.condition for event in events}
    when = when or clock_in(health.timezone)
    state = f"{texts.translated(health.state)} {texts('since', time=when(health.since))}"
    state += "" if health.shelved is None else f" ({texts('shelved_until', time=when(health.shelved))})"
    own = {name: part for name, part in health.parts.items() if part.state is health.state}
    reasons = {reason: names for reason, names in reasons_of(own).items() if reason not in told}
    if len(reasons) == 1 and len(next(iter(reasons.values()))) == len(health.parts):
        return f"{state}: {next(iter(reasons))}"
    why = [f"{', '.join(map(texts.part, names))}: {reason}" for reason, names in reasons.items()]
    return "; ".join(filter(None, (": ".join(filter(None, (state, "; ".join(why)))), unknown_text(health, events))))


def reasons_of(parts: Mapping[str, PartDocument]) -> dict[str, list[str]]:
    """The reasons of the states of parts, and which parts have each.

    Parameters that are not determined have one reason, of whichever parts they are.
    """
    found: dict[str, tuple[list[str], list[str]]] = {}
    for name, part in parts.items():
        names, parameters = found.setdefault(part.reason.removesuffix(", ".join(part.undetermined)), ([], []))
        names.append(name)
        parameters += part.undetermined
    return {why + ", ".join(dict.fromkeys(own)): names for why, (names, own) in found.items() if why}


def unknown_text(health: HealthDocument, events: Collection[EventDocument] = ()) -> str:
    """Of which parts nothing is known, and why, while others are in a worse state; without reasons of ``events``."""
    if health.state.rank <= Level.NO_DATA.rank:
        return ""
    texts, told = texts_in(health.language), {event.condition for event in events}
    parts = {name: part for name, part in health.parts.items() if part.state is Level.NO_DATA}
    rows = [(reason, names) for reason, names in reasons_of(parts).items() if reason not in told]
    why = PARTS.join(f"{', '.join(map(texts.part, names))}: {reason}" for reason, names in rows)
    return f"{texts.translated(Level.NO_DATA)}: {why}" if why else ""


def undecided_finding(document: ReportDocument) -> FindingDocument | None:
    """Return the finding of which it is open what causes it, and that no event tells of; None without one."""
    told = [event.id.partition("@")[0] for event in document.open_events]
    return next((item for item in document.findings if item.kind in UNDECIDED and item.id not in told), None)


def awaits_commissioning(document: ReportDocument) -> bool:
    """Whether the twin computes with values of its example, and does not explain the window: nothing has happened.

    Once it has explained the machine for long, something has.
    """
    if document.health is not None and document.health.has_agreed:
        return False
    rows = document.parameters.values()
    if any(row.baseline is not None for row in rows) or not any(row.is_example for row in rows):
        return False
    is_refused = document.decision is WindowDecision.REFUSED or (
        document.fit is not None and not document.fit.explained
    )
    return is_refused or undecided_finding(document) is not None


def undecided_text(document: ReportDocument, when: Clock | None = None) -> str:
    """What is new, since when, and how many causes are possible, while it is open which one holds; else empty.

    Before the machine was commissioned nothing is new: then that it has to be.
    """
    if awaits_commissioning(document):
        return texts_in(document.health.language if document.health else "en")("awaits_commissioning")
    if (finding := undecided_finding(document)) is None:
        return ""
    texts = texts_in(document.health.language if document.health else "en")
    when = when or clock_in(zone_of(document))
    what = finding.condition if finding.kind is FindingKind.OPEN else texts("changed")
    count, since = len(document.explanations), texts("since", time=when(finding.since))
    causes = texts("candidates", count=count) if count > 1 else ""
    return texts("undecided", what=what, since=since, causes=causes)


def undecided_advice(document: ReportDocument) -> str:
    """What to do while there is an :func:`undecided_text`; empty if what is known requires action."""
    if document.health is not None and document.health.state is Level.ACT:
        return ""
    key = "commission_advice" if awaits_commissioning(document) else "undecided_advice"
    return texts_in(document.health.language if document.health else "en")(key)


def zone_of(document: ReportDocument) -> str | None:
    """The zone of times for people; None for that of this computer."""
    return None if document.health is None else document.health.timezone


def brief(document: ReportDocument, when: Clock | None = None) -> str:
    """A report in one English line of at most :data:`LINE` characters: time, state, the parameters that have room."""
    when = when or clock_in(zone_of(document))
    window = f"window {document.window.index} {document.window.quality.verdict}"
    line = " ".join([when(document.window.end), *_state_words(document), window])
    values = [f"{name} {value_text(parameter)}" for name, parameter in document.parameters.items()]
    for index, text in enumerate(values):
        left = len(values) - index - 1
        rest = f", and {left} more" if left else ""
        if len(f"{line}, {text}{rest}") > LINE:
            return f"{line}, and {left + 1} more"
        line += f", {text}"
    return line


def summary(document: ReportDocument, before: ReportDocument | None = None) -> str:
    """A report in one line: state, window, parameters, findings, and the first warning of the driver.

    What the line of the report ``before`` it has said is counted.
    """
    parts = [*_state_words(document), f"window {document.window.index} {document.window.quality.verdict}"]
    said = {} if before is None else _notices(before)
    for name, parameter in document.parameters.items():
        known = None if before is None else before.parameters.get(name)
        is_known = known is not None and (known.status, known.reason) == (parameter.status, parameter.reason)
        text = f"{name} {value_text(parameter)}" if is_known else parameter_text(name, parameter)
        parts += [text, forecast_text(parameter, document.window.end)]
    notices = _notices(document)
    new = [text for key, text in notices.items() if key not in said]
    same = len(notices) - len(new)
    parts += [*new, f"{same} as before" if same else ""]
    more = len(document.driver.warnings) - 1 if document.driver is not None else 0
    parts += [f"and {more} more warnings"] if more > 0 and new else []
    return ", ".join(filter(None, parts))


def _state_words(document: ReportDocument) -> list[str]:
    """Return the state of the machine as people read it in English; empty if the report has none."""
    return [] if document.health is None else [texts_in("en").translated(document.health.state)]


def _notices(document: ReportDocument) -> dict[str, str]:
    """Return findings, a missing connection and the first warning of the driver, by what each is about."""
    notices = {f"{row.id or row.text} {row.severity}": finding_text(row) for row in document.findings}
    if (driver := document.driver) is not None:
        notices |= {} if driver.up else {f"connection {driver.reason}": f"no connection: {driver.reason}"}
        notices |= {f"warning {text}": text for text in driver.warnings[:1]}
    return notices
