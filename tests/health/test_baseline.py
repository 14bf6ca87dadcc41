"""Relative limits refer to the healthy machine; report and events say so."""

from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from otolith.adaptation.fingerprints import fingerprint_of
from otolith.adaptation.state import EVERYTHING, OperatorDecisions, apply_decisions, initial_state
from otolith.cli.main import cli
from otolith.health.events import HealthState, assess
from otolith.health.limits import Level, Limit, MonitoredQuantity
from otolith.health.prognosis import MIN_POINTS, Baseline, History, find_baseline, with_baseline, with_baselines
from otolith.health.schema import ForecastDocument
from otolith.machine import load_machine
from otolith.storage.state_store import StateStore
from otolith_drivers.errors import OtolithError
from tests.conftest import OwnMachine
from tests.health.test_events import PLAN, report

LIMITS = (Limit(Level.WATCH, 6.175, True, True), Limit(Level.ACT, 5.9, True), Limit(Level.ACT, 9.0, False))
QUANTITY = MonitoredQuantity("winding", "armature resistance", "ohm", 6.5, LIMITS)
HEALTHY = Baseline(7.0, 0.01, 200, 400.0)


def history(value: float, count: int) -> History:
    return tuple((2.0 * index, value + 0.01 * (-1) ** index, 1e-4) for index in range(count))


def test_a_baseline_is_the_mean_of_enough_estimates() -> None:
    assert find_baseline(history(1.0, MIN_POINTS - 1), QUANTITY).baseline is None
    known = find_baseline(history(7.0, 200), QUANTITY).baseline
    assert known is not None
    assert known.value == pytest.approx(7.0)
    assert known.sd == pytest.approx(0.01 * 2**0.5)  # not divided by the number: the errors are correlated
    assert (known.windows, known.end) == (200, 398.0)


def test_estimates_from_windows_near_standstill_are_not_counted() -> None:
    moving = history(7.0, 60)
    still = tuple((200.0 + 2.0 * index, 7.0 + 3.0 * (-1) ** index, 4.0) for index in range(30))
    found = find_baseline((*moving, *still), QUANTITY)
    assert found.baseline is not None
    assert found.baseline.value == pytest.approx(7.0, abs=1e-3)
    assert found.baseline.sd < 0.02
    assert (found.baseline.windows, found.vague) == (60, 30)
    assert found.interval == pytest.approx(1.96 * 2.0, rel=1e-3)


def test_a_baseline_with_an_interval_as_large_as_its_value_is_none() -> None:
    """Of a friction of 0.020 ± 0.017 limits in percent would be those of chance."""
    vague = tuple((2.0 * index, 0.02, (0.017 / 1.96) ** 2) for index in range(50))
    found = find_baseline(vague, replace(QUANTITY, nominal=0.02))
    assert found.baseline is None
    assert "85%" in found.reason


def test_a_baseline_wider_than_its_nearest_limit_is_kept_and_named() -> None:
    wide = tuple((2.0 * index, 7.0, (0.5 / 1.96) ** 2) for index in range(50))
    found = find_baseline(wide, QUANTITY)
    assert found.baseline is not None
    assert "7%" in found.reason
    assert "5%" in found.reason
    assert not find_baseline(history(7.0, 50), QUANTITY).reason


def test_limits_in_percent_refer_to_the_baseline_and_others_stay() -> None:
    quantity = with_baseline(QUANTITY, HEALTHY)
    assert [limit.value for limit in quantity.limits] == pytest.approx([6.65, 5.9, 9.0])
    assert quantity.nominal == 7.0
    assert with_baseline(QUANTITY, None) == QUANTITY
    assert with_baseline(QUANTITY, replace(HEALTHY, value=-1.0)) == QUANTITY


def test_report_and_event_name_the_baseline() -> None:
    plan = with_baselines(replace(PLAN, parameters={"R_a": QUANTITY}), {"R_a": HEALTHY})
    state = HealthState()
    for index in range(5):
        state, document = assess(plan, state, report(index, 6.5))
    assert document.parameters["R_a"].baseline == 7.0
    (event,) = document.events
    assert event.state is Level.WATCH
    assert "(-7.1% of the baseline), below its limit 6.65 Ω" in event.text
    without = assess(with_baselines(plan, {}), HealthState(), report(0, 6.5))[1]
    assert without.parameters["R_a"].baseline is None


def test_a_decision_replaces_the_plan_and_its_forecasts(own_machine: OwnMachine) -> None:
    machine = load_machine(own_machine.machine, with_driver=False)
    forecasts = {"R_a": ForecastDocument(computed=1.0, reason="no trend")}
    state = initial_state("m", "s", machine.problem, machine.plan)
    state = replace(state, health=HealthState(forecasts=forecasts))
    assert apply_decisions(state, OperatorDecisions()).health.forecasts == forecasts
    changed = apply_decisions(state, OperatorDecisions(baselines={"R_a": HEALTHY, "unknown": HEALTHY}))
    assert changed.plan.parameters["R_a"].nominal == 7.0
    assert changed.health.forecasts == {}
    assert apply_decisions(changed, OperatorDecisions()).plan.parameters == machine.plan.parameters


def test_a_baseline_of_other_values_waits_for_a_daemon_that_has_them(own_machine: OwnMachine) -> None:
    """With those of the twin's example the same machine has another resistance: its limits would be those of chance."""
    machine = load_machine(own_machine.machine, with_driver=False)
    state = initial_state("m", "s", machine.problem, machine.plan)
    first = replace(HEALTHY, model=fingerprint_of(machine.problem))
    running = apply_decisions(state, OperatorDecisions(baselines={"R_a": first}))
    known = tuple((name, 1.1 * value) for name, value in machine.problem.known)
    restarted = initial_state("m", "s", replace(machine.problem, known=known), machine.plan)
    second = replace(HEALTHY, value=4.0, model=fingerprint_of(restarted.problem))
    decisions = OperatorDecisions(baselines={"R_a": second})
    assert apply_decisions(state, decisions).plan.parameters == machine.plan.parameters
    kept = apply_decisions(running, replace(decisions, resets={EVERYTHING: 1.0}))
    assert kept.plan.parameters == running.plan.parameters
    assert apply_decisions(replace(kept, plan=machine.plan), decisions).plan.parameters == running.plan.parameters
    assert apply_decisions(kept, OperatorDecisions()).plan.parameters == machine.plan.parameters
    assert apply_decisions(restarted, decisions).plan.parameters["R_a"].nominal == 4.0
    assert (decisions.waiting(running.problem), decisions.waiting(restarted.problem)) == (("R_a",), ())


def test_the_command_takes_the_saved_estimates(
    own_machine: OwnMachine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    machine = load_machine(own_machine.machine, with_driver=False)
    names = machine.file.machine
    store = StateStore(names.site, names.name, machine.twin)
    arguments = ["baseline", str(own_machine.machine)]
    with pytest.raises(OtolithError, match=r"R_a.*20 are needed"):
        CliRunner().invoke(cli, arguments, catch_exceptions=False, standalone_mode=False)
    state = initial_state(names.name, names.site, machine.problem, machine.plan)
    store.save(replace(state, health=HealthState(histories={"R_a": history(7.0, 50)})))
    result = CliRunner().invoke(cli, arguments, catch_exceptions=False)
    assert "baseline R_a = 7.000 ± 0.028 Ω, mean of 50 estimates" in result.output
    assert "beyond its limit" not in result.output
    assert store.decisions().baselines["R_a"].value == pytest.approx(7.0)
    assert store.decisions().baselines["R_a"].model == fingerprint_of(machine.problem)
    store.save(replace(state, health=HealthState(histories={"R_a": history(5.9, 50)})))
    worn = CliRunner().invoke(cli, arguments, catch_exceptions=False)
    assert (
        "R_a: beyond its limit ACT below 6.175 Ω; if the machine is not healthy, undo it: otolith baseline --clear"
        in worn.output
    )
    CliRunner().invoke(cli, [*arguments, "--clear"], catch_exceptions=False)
    assert store.decisions().baselines == {}
