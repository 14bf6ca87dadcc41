"""Diagnosis: from findings to conditions, causes and advice, by the rows of ``rules.toml``.

A row matches a finding if every key that it has agrees; one of a limit that names a parameter also matches a parameter
that has moved without being estimated. Of the rows that match, those of the machine file come first, then those with
most keys, which rest on most evidence. If several remain, the data do not distinguish them: they are given together,
and none is preferred. The plan of a machine has its rows beside the limits of what is monitored.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from otolith.health.limits import Level, MonitoredQuantity
from otolith.health.schema import FindingKind, HeldDocument, Language
from otolith.health.text import Texts, texts_in
from otolith_drivers.config_files import Range, StrictModel

LIMITS = (FindingKind.LIMIT, FindingKind.LIMIT_FROM_START)  # Findings whose level is that of the limit
MATERIAL_ERROR = 0.1  # of a signal: an error of its sensor that matters whatever the limits are
COMMAND = "command"  # Input of a wrong signal that is one
KEYS = ("twin", "subject", "unit", "side", "manner", "family", "input")


@dataclass(frozen=True, slots=True)
class FindingFeatures:
    """What the rules look at; empty where it is not known or does not apply."""

    finding: FindingKind
    twin: str = ""
    subject: str = ""  # Parameter, site or signal
    side: str = ""  # Of the nominal value on which a parameter is, or of zero on which a delay: below or above
    manner: str = ""  # How a parameter came there, by a step or by a trend; or that it was so from the start
    family: str = ""
    input: str = ""  # t, angle, or another signal or state; of a wrong signal, command if it is one
    order: float | None = None  # Of a component that is periodic in an angle
    order_reach: float = 0.0  # Half of its 95 % interval
    unit: str = ""  # Of the site of a component: what is added there


class _Row(StrictModel):
    """The values that a rule matches. A key without values matches everything."""

    id: str = Field(min_length=1)  # Of a packaged row, the key of its texts in `texts/`
    finding: FindingKind
    twin: tuple[str, ...] = ()
    subject: tuple[str, ...] = ()
    unit: tuple[str, ...] = ()
    side: tuple[Literal["below", "above"], ...] = ()
    manner: tuple[Literal["step", "trend", "from the start", "colder"], ...] = ()
    family: tuple[str, ...] = ()
    input: tuple[str, ...] = ()
    order: Range | None = None  # Lowest and highest order
    severity: Literal["HINT", "WATCH", "ACT"] = "WATCH"  # Level of what has no limits
    stop: Literal["", "now", "soon", "no", "sensor"] = ""
    """Whether to stop the machine; ``sensor`` if something that protects uses it, empty for what its state says."""


def _own_id(text: str) -> str:
    """Return the id of a rule, or raise ValueError for one that joined ids, a command line or a link would change."""
    if not re.fullmatch("[a-z0-9][a-z0-9-]*", text):
        allowed = "use small letters a-z, digits 0-9 and '-', and begin with a letter or digit"
        raise ValueError(f"{text!r} is no id of a rule: {allowed}")
    return text


class OwnRule(_Row):
    """A row of a machine file, and what it means."""

    id: Annotated[str, AfterValidator(_own_id)]
    condition: str = Field(min_length=1)
    cause: str = Field(min_length=1)
    advice: str = Field(min_length=1)
    source: str = "the machine file"


class Rule(_Row):
    """A row, and what it means."""

    condition: str = ""  # Empty until worded, as are cause and advice
    cause: str = ""
    advice: str = ""
    source: str
    is_own: bool = False  # Whether it is of the machine file; where such a row matches, no packaged one counts

    @property
    def rank(self) -> tuple[bool, int]:
        """Whether it is of the machine file, and the number of keys that a finding must agree with."""
        return self.is_own, sum(bool(getattr(self, key)) for key in (*KEYS, "order"))

    def matches(self, features: FindingFeatures) -> bool:
        """Whether the row applies."""
        agree = all(not (own := getattr(self, key)) or getattr(features, key) in own for key in KEYS)
        low, high = self.order or (0.0, 0.0)
        reach, order = features.order_reach, features.order
        in_order = self.order is None or (order is not None and low - reach <= order <= high + reach)
        is_moved = features.finding is FindingKind.MOVED and self.finding is FindingKind.LIMIT and bool(self.subject)
        return (self.finding is features.finding or is_moved) and agree and in_order


class RulesFile(StrictModel):
    """The file of rules."""

    rule: tuple[Rule, ...]


@dataclass(frozen=True, slots=True)
class MonitoringPlan:
    """What is monitored of a machine, and the rules of the diagnosis. Plain: it pickles."""

    parameters: Mapping[str, MonitoredQuantity] = field(default_factory=dict)  # Of the estimated parameters
    sites: Mapping[str, MonitoredQuantity] = field(default_factory=dict)  # Of the amplitude of a component there
    rules: Sequence[Rule] = ()
    stated: Mapping[str, MonitoredQuantity] | None = None  # As the machine file states them, if there is a baseline
    language: Language = "en"  # Of the texts for people
    timezone: str = ""  # IANA name of the zone of times for people; that of the reader's computer without it
    known: Mapping[str, MonitoredQuantity] = field(default_factory=dict)
    """Of the parameters that are not estimated, against the values of the machine file."""
    signals: Mapping[str, str] = field(default_factory=dict)  # Their meanings
    commands: frozenset[str] = frozenset()  # Inputs of the twin that hold their value between samples
    varying: frozenset[str] = frozenset()  # Parameters whose sudden changes are ordinary, as of an unknown load

    @property
    def texts(self) -> Texts:
        """The texts in the language of the machine."""
        return texts_in(self.language)

    def with_held(self, held: Mapping[str, tuple[str, ...]], varying: frozenset[str]) -> "MonitoringPlan":
        """Return the plan with the parameters with which others are right or wrong, and those that vary."""

        def quantities(rows: Mapping[str, MonitoredQuantity]) -> dict[str, MonitoredQuantity]:
            own = {name: tuple(other for other in held.get(name, ()) if other in self.known) for name in rows}
            return {name: replace(row, as_right_as=own[name]) for name, row in rows.items()}

        parameters, known = quantities(self.parameters), quantities(self.known)
        return replace(self, parameters=parameters, known=known, varying=varying)

    def held_with(self, name: str) -> dict[str, HeldDocument]:
        """Return the held values with which the value of a parameter is right or wrong."""
        held = {other: self.known[other] for other in {**self.known, **self.parameters}[name].as_right_as}
        return {other: HeldDocument(value=row.nominal, unit=row.unit) for other, row in held.items()}

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the twin, in the order of its parameters and sites."""
        quantities = (*self.parameters.values(), *self.sites.values())
        return tuple(dict.fromkeys(quantity.part for quantity in quantities))

    @property
    def act_distance(self) -> float:
        """Smallest share of a healthy value at which a parameter is at ACT; at most :data:`MATERIAL_ERROR`."""
        shares = [
            abs(limit.value / quantity.nominal - 1.0)
            for quantity in self.parameters.values()
            for limit in quantity.limits
            if limit.level is Level.ACT and quantity.nominal
        ]
        return min([*shares, MATERIAL_ERROR])

    def parameters_of(self, part: str) -> list[str]:
        """Return the names of the estimated parameters of a part."""
        return [name for name, quantity in self.parameters.items() if quantity.part == part]


def matching(rules: Sequence[Rule], features: FindingFeatures) -> list[Rule]:
    """Return the rows that rest on most evidence; several if the data do not distinguish them."""
    rows = [rule for rule in rules if rule.matches(features)]
    first = max((rule.rank for rule in rows), default=None)
    return [rule for rule in rows if rule.rank == first]


def worded(rules: Sequence[Rule], texts: Texts) -> tuple[Rule, ...]:
    """Return the rules with condition, cause and advice in the language of ``texts``."""
    return tuple(rule.model_copy(update=texts.rules[rule.id]) for rule in rules)


def diagnose(rules: Sequence[Rule], features: FindingFeatures, texts: Texts | None = None) -> dict[str, str]:
    """Return ids, condition, cause, advice and source of the rows that match, alternatives joined; empty without one.

    ``texts`` has the joints; English by default.
    """
    rows, texts = matching(rules, features), texts or texts_in("en")
    joints = {"id": " ", "condition": texts("or"), "cause": texts("alternatives"), "advice": "; ", "source": "; "}
    joined = {key: joint.join(dict.fromkeys(getattr(rule, key) for rule in rows)) for key, joint in joints.items()}
    return {"condition_id" if key == "id" else key: text for key, text in joined.items() if rows}


def severity(rules: Sequence[Rule], features: FindingFeatures) -> Level:
    """Return the level of a finding without limits: ACT or HINT if each row that matches has it."""
    levels = {Level(rule.severity) for rule in matching(rules, features)}
    return levels.pop() if len(levels) == 1 else Level.WATCH
