"""The rules of the diagnosis: one contract over each row, and classes where the data do not distinguish."""

from dataclasses import replace
from typing import Any

import pytest

from otolith.health.diagnosis import KEYS, FindingFeatures, Rule, diagnose, matching, severity
from otolith.health.schema import FindingKind
from otolith.machine import find_twin, library_twins, load_rules
from otolith.twin.components import FAMILY_NAMES
from otolith.twin.unmeasured import Assumption, UnmeasuredInput, without_sensor
from tests.messages import assert_says

RULES = load_rules()
TWINS = {name: find_twin(name) for name in library_twins()}
WITHOUT_LOAD = [
    without_sensor(twin, UnmeasuredInput("T_load", Assumption.FRICTION))
    for twin in TWINS.values()
    if "T_load" in {row.name for row in twin.inputs}
]
PARAMETERS = {parameter.name for twin in (*TWINS.values(), *WITHOUT_LOAD) for parameter in twin.parameters}
SITES = {site.name for twin in TWINS.values() for site in twin.sites}


def example(rule: Rule) -> FindingFeatures:
    """Return a finding that the row must match, and no row that rests on more evidence."""
    first: dict[str, Any] = {key: next(iter(getattr(rule, key)), "") for key in KEYS}
    return FindingFeatures(rule.finding, **first, order=None if rule.order is None else sum(rule.order) / 2.0)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: f"{rule.finding}: {rule.condition}")
def test_every_rule_is_given_where_it_applies(rule: Rule) -> None:
    features = example(rule)
    assert rule in matching(RULES, features)
    diagnosis = diagnose(RULES, features)
    assert rule.condition in diagnosis["condition"]
    assert rule.advice in diagnosis["advice"]
    assert rule.source in diagnosis["source"]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: f"{rule.finding}: {rule.condition}")
def test_every_rule_names_what_exists(rule: Rule) -> None:
    assert set(rule.twin) <= set(TWINS)
    assert set(rule.subject) <= (PARAMETERS if rule.finding is FindingKind.LIMIT else SITES)
    assert set(rule.family) <= set(FAMILY_NAMES)
    assert set(rule.input) <= ({"command"} if rule.finding is FindingKind.SENSOR else {"t", "angle"})
    assert set(rule.unit) <= {site.unit for twin in TWINS.values() for site in twin.sites}
    for text in (rule.condition, rule.cause, rule.advice, rule.source):
        assert text == text.strip()
        assert text


@pytest.mark.parametrize("name", TWINS)
@pytest.mark.parametrize("side", ["below", "above"])
@pytest.mark.parametrize("manner", ["", "step", "trend"])
def test_a_rule_of_another_machine_is_no_alternative_to_one_of_this_twin(name: str, side: str, manner: str) -> None:
    """The damping of a hydraulic circuit is no friction of bearings."""
    for parameter in TWINS[name].parameters:
        rows = matching(RULES, FindingFeatures(FindingKind.LIMIT, name, parameter.name, side, manner))
        assert len({bool(rule.twin) for rule in rows}) <= 1, [rule.condition for rule in rows]


@pytest.mark.parametrize("name", TWINS)
def test_gas_is_looked_for_only_in_machines_that_move_a_liquid(name: str) -> None:
    """A fan moves air: neither venting nor a level is there to be checked."""
    (rule,) = matching(RULES, FindingFeatures(FindingKind.RETURNS, name))
    assert (rule.id == "returns-of-a-fluid") == (name in {"pump", "hydraulic_actuator"})


def test_every_kind_of_event_has_a_rule() -> None:
    for kind in set(FindingKind) - {FindingKind.OPEN, FindingKind.COMPONENT}:
        assert matching(RULES, FindingFeatures(kind))
    assert all(matching(RULES, FindingFeatures(FindingKind.COMPONENT, family=family)) for family in FAMILY_NAMES)


@pytest.mark.parametrize("name", TWINS)
def test_every_parameter_with_limits_and_every_site_belongs_to_a_part(name: str) -> None:
    for parameter in TWINS[name].parameters:
        assert parameter.part or not (parameter.watch or parameter.act)
    assert all(site.part for site in TWINS[name].sites)


@pytest.mark.parametrize(
    ("features", "condition"),
    [
        (
            FindingFeatures(FindingKind.LIMIT_FROM_START, "pump", "h_0", "below", "trend"),
            "a nominal value that does not fit, or a fault that is older than the monitoring",
        ),
        (
            FindingFeatures(FindingKind.LIMIT, "dc_motor", "R_a", "below", "trend"),
            "short circuit between turns of the winding",
        ),
        (FindingFeatures(FindingKind.LIMIT, "dc_motor", "K_e", "below"), "the magnetic field of the motor is weaker"),
        (
            FindingFeatures(
                FindingKind.COMPONENT, "dc_motor", "shaft", unit="N*m", family="periodic", input="angle", order=1.0
            ),
            "unbalanced shaft",
        ),
        (
            FindingFeatures(
                FindingKind.COMPONENT, "dc_motor", "shaft", unit="N*m", family="periodic", input="angle", order=2.0
            ),
            "shaft misalignment",
        ),
        (
            FindingFeatures(FindingKind.COMPONENT, "hydraulic_actuator", "pressure", family="constant"),
            "a leak of the hydraulic circuit",
        ),
        (FindingFeatures(FindingKind.LIMIT, "pump", "h_0", "below", "trend"), "the pump builds up less head"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_faults_of_the_paper_have_their_condition(features: FindingFeatures, condition: str) -> None:
    assert diagnose(RULES, features)["condition"] == condition


@pytest.mark.parametrize(("order", "is_unbalance"), [(0.93, False), (0.93, True), (1.0, True)])
def test_an_uncertain_order_leaves_the_condition_that_its_interval_holds(order: float, is_unbalance: bool) -> None:
    """As after hours at rest, when the order has become uncertain."""
    reach = 0.05 if is_unbalance else 0.001
    features = FindingFeatures(
        FindingKind.COMPONENT,
        "own",
        "rotor",
        unit="N*m",
        family="periodic",
        input="angle",
        order=order,
        order_reach=reach,
    )
    condition = diagnose(RULES, features)["condition"]
    assert (condition == "unbalanced shaft") == is_unbalance


SHAFT = FindingFeatures(FindingKind.COMPONENT, "own", "rotor", unit="N*m", family="periodic", input="angle")


@pytest.mark.parametrize(
    ("features", "words", "not_words"),
    [
        (replace(SHAFT, order=1.0), ("unbalance",), ()),
        (replace(SHAFT, order=0.273), ("whole number",), ("unbalance",)),
        (replace(SHAFT, order=1.6), ("whole number",), ("unbalance", "misalign")),
        (replace(SHAFT, unit="V", order=1.0), ("voltage",), ("unbalance",)),
        (replace(SHAFT, unit="V", input="t"), ("voltage",), ("unbalance",)),
        (replace(SHAFT, subject="shaft", unit="1", order=1.0), ("repeats",), ("unbalance",)),
        (replace(SHAFT, unit="V", family="Coulomb", input="i"), ("voltage drop",), ("friction",)),
        (replace(SHAFT, family="negative exponential", input="t"), ("dies away",), ("crack",)),
        (FindingFeatures(FindingKind.COMPONENT, "hydraulic_actuator", "flow", unit="m^3/s", family="linear", input="t"),
         ("drifts",), ("leakage",)),
        (FindingFeatures(FindingKind.COMPONENT, "hydraulic_actuator", "flow", unit="m^3/s", family="linear", input="p"),
         ("leakage flow",), ("drifts",)),
    ],
)  # fmt: skip
def test_a_component_is_named_by_what_it_adds_and_not_by_the_name_of_its_site(
    features: FindingFeatures, words: tuple[str, ...], not_words: tuple[str, ...]
) -> None:
    condition = diagnose(RULES, features)["condition"]
    assert_says(condition, *words)
    assert not [word for word in not_words if word in condition]


def test_gas_in_a_pump_sends_nobody_to_the_terminals_first() -> None:
    for twin in ("pump", "dc_motor"):
        advice = diagnose(RULES, FindingFeatures(FindingKind.RETURNS, twin))["advice"]
        assert advice.index("the times") < min(
            advice.find(word) for word in ("contacts", "terminals") if word in advice
        )
    assert "venting" in diagnose(RULES, FindingFeatures(FindingKind.RETURNS, "pump"))["advice"]


def test_conditions_that_the_data_do_not_distinguish_are_one_class() -> None:
    constant = FindingFeatures(FindingKind.COMPONENT, "dc_motor", "shaft", unit="N*m", family="constant")
    diagnosis = diagnose(RULES, constant)
    assert_says(diagnosis["condition"], "constant torque", "shaft", "offset of the load sensor")
    assert "without load" in diagnosis["advice"]
    hot = diagnose(RULES, FindingFeatures(FindingKind.LIMIT, "dc_motor", "R_a", "above", "trend"))
    assert "hotter" in hot["condition"]
    assert "contact" in hot["condition"]


def test_a_class_calls_for_action_only_if_each_member_does() -> None:
    rows = [
        Rule(id=level, finding=FindingKind.SENSOR, condition=level, cause="c", advice="a", severity=level, source="s")
        for level in ("ACT", "WATCH")
    ]
    features = FindingFeatures(FindingKind.SENSOR)
    assert severity(rows, features) == "WATCH"
    assert severity(rows[:1], features) == "ACT"
    assert severity((), features) == "WATCH"
