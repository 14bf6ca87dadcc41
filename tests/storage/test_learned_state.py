"""What was learned survives a restart: the same bits, intervals that hold the truth, and no damaged file is used."""

import json
import logging
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.discovery.motor import R_A, D, Faults, simulate_motor
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith.adaptation.state import (
    EVERYTHING,
    AdaptationState,
    Ledger,
    OperatorDecisions,
    apply_decisions,
    component_records,
    initial_state,
    with_problem,
)
from otolith.discovery.decision import Approval
from otolith.estimation.imm_filter import UNKNOWN_AWAY, ParameterCusum
from otolith.health.events import HealthState
from otolith.health.schema import EventChange, ForecastDocument, ReportDocument, Status
from otolith.machine import load_machine
from otolith.storage.decisions import MAX_STATE_BYTES
from otolith.storage.learned_state import LearnedState, learned_state, restored
from otolith.storage.state_store import MAX_KEPT, StateStore
from otolith_drivers.errors import OtolithError
from tests.conftest import EXAMPLES
from tests.messages import assert_says
from tests.runtime.motors import NAMES, PROBLEM, START, UNBALANCE, fresh, healthy, noisy, run, unbalanced, windows

KEPT = Path(__file__).parents[1] / "golden" / "state_files"
TRUTH = {"R_a": R_A, "D": D}
YEAR = 365 * 86_400.0  # s
STATES = (healthy, unbalanced, noisy)


def store_in(folder: Path, signals: str = "") -> StateStore:
    machine, site = NAMES
    return StateStore(site, machine, PROBLEM.base_model, folder, signals)


def restarted(state: AdaptationState, folder: Path) -> AdaptationState:
    store = store_in(folder)
    store.save(state)
    warm, note = store_in(folder).restore(fresh())
    assert note == ""
    return warm


def holds_truth(report: ReportDocument) -> bool:
    """Whether every parameter has an interval that holds its true value."""
    values = [(report.parameters[name], truth) for name, truth in TRUTH.items()]
    return all(
        item.low is not None and item.high is not None and item.low <= truth <= item.high for item, truth in values
    )


@pytest.mark.parametrize("make", STATES)
def test_a_restored_state_gives_the_same_reports_bit_for_bit(
    make: Callable[[], AdaptationState], tmp_path: Path
) -> None:
    state = replace(make(), test=None)
    warm = restarted(state, tmp_path)
    assert warm.problem == state.problem
    for name in ("level", "mean", "covariance", "weight"):
        own, other = (getattr(each.posterior.belief, name) for each in (warm, state))
        assert own.dtype == other.dtype
        assert own.tobytes() == other.tobytes()
    assert warm.posterior.belief.end == state.posterior.belief.end
    modes = [each.posterior.with_constants().belief for each in (warm, state)]
    assert len(modes[0].weight) > len(warm.posterior.belief.weight)
    for name in ("level", "mean", "covariance", "weight"):
        assert getattr(modes[0], name).tobytes() == getattr(modes[1], name).tobytes()
    assert warm.adopted == state.adopted
    after = windows(simulate_motor("sweep", 4.0, Faults(), seed=4), START + 26.0)
    reports = [[report.to_json() for report in run(each, after)[1]] for each in (warm, state)]
    assert reports[0] == reports[1]


def test_noise_of_inputs_is_restored_and_older_files_lack_it(tmp_path: Path) -> None:
    state, levels = healthy(), [2.0 * level for level in PROBLEM.levels]
    document = learned_state(with_problem(state, PROBLEM.with_levels(levels)), "")
    assert document.filter is not None
    assert restored(document, fresh()).problem.levels == tuple(levels)
    older = with_problem(state, PROBLEM.with_levels((*PROBLEM.levels[:2], *levels[2:])))
    for count, known in ((2, older.problem.levels), (0, (*levels[:4], *PROBLEM.levels[4:]))):
        record = document.filter.model_copy(update={"noise": tuple(levels[count:4])})
        warm = restored(document.model_copy(update={"filter": record}), fresh())
        assert warm.problem.levels == known


@pytest.mark.parametrize("away", [20.0, 8 * 3600.0, YEAR, -3600.0, -YEAR, -START], ids=lambda away: f"{away:g} s")
@pytest.mark.parametrize("make", [healthy, noisy])
def test_the_first_reports_hold_the_truth_however_long_the_daemon_was_away(
    make: Callable[[], AdaptationState], away: float, tmp_path: Path
) -> None:
    """A negative time is a clock that was set back meanwhile."""
    start = START + 24.0 + away
    warm = restarted(make(), tmp_path)
    _, reports = run(warm, windows(simulate_motor("sweep", 4.0, Faults(), seed=11), start))
    assert any(map(holds_truth, reports))
    assert holds_truth(reports[-1])
    assert {item.status for item in reports[0].parameters.values()} <= {Status.ESTIMATED, Status.HELD}


def test_variance_grows_by_the_time_away_or_by_that_of_an_unknown_time(tmp_path: Path) -> None:
    deviations = []
    (window,) = windows(simulate_motor("sweep", 2.0, Faults(), seed=11), START + 18.0)
    for away in (0.0, UNKNOWN_AWAY, -3600.0):
        warm = restarted(healthy(), tmp_path)
        predicted = warm.posterior.predict(replace(window, start=START + 18.0 + away))
        deviations.append(math.sqrt(predicted.prior().covariance[0, 0]))
    assert deviations[1] > 3.0 * deviations[0]
    assert deviations[2] == pytest.approx(deviations[1], rel=0.01)


@pytest.mark.parametrize("make", [healthy, unbalanced])
def test_a_step_while_the_daemon_was_away_is_found_as_without_a_restart(
    make: Callable[[], AdaptationState], tmp_path: Path
) -> None:
    state = replace(make(), test=None)
    moved = 1.1 * R_A
    torque = (lambda _, angle, *__: 0.004 * math.sin(angle)) if state.adopted else Faults().torque
    after = windows(simulate_motor("sweep", 16.0, Faults(resistance=moved, torque=torque), seed=12), START + 60.0)
    warm, reports = run(restarted(state, tmp_path), after)
    assert [report.to_json() for report in reports] == [report.to_json() for report in run(state, after)[1]]
    low, high = reports[-1].parameters["R_a"].low, reports[-1].parameters["R_a"].high
    assert low is not None
    assert high is not None
    assert low <= moved <= high
    assert warm.is_valid


def test_an_open_event_goes_on_after_a_restart(tmp_path: Path) -> None:
    state = unbalanced()
    assert state.health.records
    warm = restarted(state, tmp_path)
    assert warm.health == state.health
    torque = Faults(torque=lambda _, angle, *__: 0.004 * math.sin(angle))
    _, reports = run(warm, windows(simulate_motor("sweep", 8.0, torque, seed=4), START + 60.0))
    open_before = {event.id for event in state.health.open_events}
    assert open_before
    for report in reports:
        assert {event.id for event in report.events} == open_before
        assert not any(event.change is EventChange.RAISED for event in report.events)


def test_what_shifted_the_last_windows_survives_a_restart(tmp_path: Path) -> None:
    state = healthy()
    sums = np.tile([[3.0], [0.5]], len(state.problem.free))
    shifted = replace(state, ledger=Ledger(ParameterCusum(sums)))
    assert restarted(shifted, tmp_path).ledger.cusum.sums == pytest.approx(sums)
    with pytest.raises(OtolithError, match="shifts: not plausible"):
        store_in(tmp_path).save(replace(state, ledger=Ledger(ParameterCusum(-sums))))


def test_histories_survive_a_restart_and_forecasts_are_computed_again(tmp_path: Path) -> None:
    history = tuple((START + 2.0 * index, R_A + 0.01 * index, 1e-4) for index in range(40))
    forecasts = {"R_a": ForecastDocument(computed=START + 78.0, reason="no trend")}
    state = replace(healthy(), health=HealthState(histories={"R_a": history}, forecasts=forecasts))
    assert restarted(state, tmp_path).health == HealthState(histories={"R_a": history})
    wrong = replace(state, health=HealthState(histories={"R_a": history[::-1]}))
    with pytest.raises(OtolithError, match="a history is not plausible"):
        store_in(tmp_path).save(wrong)


def test_only_the_newest_refused_files_are_kept(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    for number in range(MAX_KEPT + 3):
        store.components_path.parent.mkdir(parents=True, exist_ok=True)
        store.components_path.write_text(f"damaged {number}", encoding="utf-8")
        _, note = store.restore(fresh())
        assert "kept" in note
    kept = sorted(path for path in store.components_path.parent.iterdir() if path.name.endswith(".kept.json"))
    assert [path.read_text(encoding="utf-8") for path in kept] == [f"damaged {n}" for n in range(3, MAX_KEPT + 3)]


def test_a_refused_file_is_kept_although_others_are_from_a_clock_that_was_ahead(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    store.components_path.parent.mkdir(parents=True, exist_ok=True)
    for number in range(MAX_KEPT):
        store.components_path.with_suffix(f".2099010{number}T000000000000.kept.json").touch()
    store.components_path.write_text("damaged", encoding="utf-8")
    kept = store.set_aside()
    assert kept.read_text(encoding="utf-8") == "damaged"
    assert len(list(kept.parent.glob("*.kept.json"))) == MAX_KEPT


def test_a_component_is_still_there_after_a_year(tmp_path: Path) -> None:
    torque = lambda _, angle, *__: 0.004 * math.sin(angle)  # noqa: E731 - as in the motor's faults
    after = windows(simulate_motor("sweep", 8.0, Faults(torque=torque), seed=13), START + YEAR)
    _, reports = run(restarted(unbalanced(), tmp_path), after)
    assert [[component.id for component in report.components] for report in reports] == [[UNBALANCE]] * 4
    assert all(map(holds_truth, reports[1:]))


def saved(folder: Path, make: Callable[[], AdaptationState] = unbalanced) -> tuple[StateStore, dict[str, Any]]:
    store = store_in(folder, "signals")
    store.save(make())
    return store, json.loads(store.components_path.read_text(encoding="utf-8"))


def with_value(*place: str | int, value: object) -> Callable[[dict[str, Any]], object]:
    """Return a change of a document that puts ``value`` at a place."""

    def change(document: dict[str, Any]) -> object:
        inner: Any = document
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = value
        return document

    return change


DAMAGED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "newer version": (with_value("version", value=99), "version 99"),
    "version 0": (with_value("version", value=0), "version 0"),
    "version in words": (with_value("version", value="new"), "version"),
    "other machine": (with_value("machine", value="pump"), "machine pump"),
    "other site": (with_value("site", value="there"), "at there"),
    "other twin": (with_value("twin", value="pump"), "twin has changed"),
    "other equations": (with_value("twin_fingerprint", value="0"), "twin has changed"),
    "other signals": (with_value("signal_fingerprint", value="0"), "signals"),
    "no object": (lambda _: [1, 2], "file"),
    "unknown key": (with_value("more", value=1), "more"),
    "infinite": (with_value("filter", "mean", 0, 0, value=1e400), "mean"),
    "amplitude 1e308": (with_value("components", 0, "adopted", "component", "amplitude", value=1e308), "too large"),
    "values 1e300": (with_value("components", 0, "values", 0, value=1e300), "too large"),
    "value far outside": (with_value("components", 0, "values", 0, value=5.0), "outside"),
    "no deviation": (with_value("components", 0, "deviations", 0, value=0.0), "deviations"),
    "unknown family": (with_value("components", 0, "adopted", "component", "family", value="fractal"), "fractal"),
    "unknown site": (with_value("components", 0, "adopted", "component", "site", value="roof"), "roof"),
    "mean out of bounds": (with_value("filter", "mean", 0, 0, value=50.0), "outside"),
    "negative variance": (with_value("filter", "covariance", 0, 0, 0, value=-1.0), "variance"),
    "no uncertainty": (with_value("filter", "covariance", 0, 0, 0, value=0.0), "variance"),
    "not symmetric": (with_value("filter", "covariance", 0, 0, 1, value=1.0), "symmetric"),
    "weights": (with_value("filter", "weight", 0, value=0.9), "weight"),
    "level": (with_value("filter", "level", 0, 0, value=9), "level"),
    "modes": (with_value("filter", "level", 0, value=[0]), "inhomogeneous"),
    "constants of others": (with_value("filter", "constant", "mean", value=[1.0]), "constant"),
    "constants far off": (with_value("filter", "constant", "mean", 0, value=50.0), "outside"),
    "constants for sure": (with_value("filter", "constant", "probability", value=1.0), "probability"),
    "variance ratio": (with_value("filter", "variance_ratio", value=0.1), "variance_ratio"),
    "scale": (with_value("filter", "scale", 0, value=1.0), "scale"),
    "labels": (with_value("filter", "labels", 0, value="R_b"), "labels"),
    "far future": (with_value("filter", "end", value=1e300), "too large"),
    "phase": (with_value("filter", "phase", "by", value=[1e300]), "too large"),
    "phases": (with_value("filter", "phase", "by", value=[]), "phase"),
    "noise": (with_value("filter", "noise", value=[1e9, 1e9]), "noise"),
    "steps": (with_value("filter", "steps", value=[-0.1, 0.0]), "steps"),
    "status": (with_value("filter", "previous", 0, "status", value="splendid"), "status"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_file_that_must_not_be_used_is_kept_and_the_reason_is_given(name: str, tmp_path: Path) -> None:
    store, document = saved(tmp_path)
    change, reason = DAMAGED[name]
    text = json.dumps(change(document)).replace("Infinity", "1e400")
    refuse_text(store, text.encode(), reason)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "file"),
        (b"\xff\xfe\x00", "decode"),
        (b"[" * 100_000, "file"),
        (b'{"version": 2' + b" " * MAX_STATE_BYTES + b"}", "larger than"),
    ],
    ids=["empty", "no text", "deep", "too large"],
)
def test_a_file_of_other_content_is_kept_and_the_reason_is_given(content: bytes, reason: str, tmp_path: Path) -> None:
    refuse_text(saved(tmp_path)[0], content, reason)


def refuse_text(store: StateStore, content: bytes, reason: str) -> None:
    """Check that the content of the file is refused for ``reason``, and kept beside what is saved afterwards."""
    store.components_path.write_bytes(content)
    store.operator.write(OperatorDecisions(approved=frozenset({UNBALANCE})))
    initial = fresh()
    state, note = store.restore(initial)
    assert state.posterior is initial.posterior
    assert replace(state.health, dropped=()) == initial.health
    assert not state.health.dropped or json.loads(content)["machine"] == NAMES[0] == state.machine
    assert reason in note
    assert str(store.components_path) in note
    store.save(healthy())
    (backup,) = store.components_path.parent.glob("*.kept.json")
    assert backup.name in note
    assert backup.read_bytes() == content
    assert store.decisions().approved == {UNBALANCE}


def test_a_torn_file_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    store, _ = saved(tmp_path)
    whole = store.components_path.read_bytes()
    for size in range(0, len(whole) - 2, len(whole) // 40):
        store.components_path.write_bytes(whole[:size])
        initial = fresh()
        state, note = store.restore(initial)
        assert state is initial
        assert "not used" in note
        assert any(path.read_bytes() == whole[:size] for path in tmp_path.glob("*.kept.json"))


def leaves(document: Any, place: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Places of all values."""
    items = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    return [place, *(leaf for key, value in items for leaf in leaves(value, (*place, key)))]


NUMBERS = st.integers() | st.floats()
VALUES: st.SearchStrategy[object] = (
    st.none() | st.booleans() | NUMBERS | st.text(max_size=3) | st.sampled_from([[], {}])
)
FACTORS = st.sampled_from([-1.0, 0.0, 1e-30, 0.5, 2.0, 1e3, 1e30])


SHORT = settings(max_examples=15)
LONG = settings(SHORT, max_examples=150)


def check_changed(tmp_path: Path, data: st.DataObject) -> None:
    shutil.rmtree(tmp_path)
    store, document = saved(tmp_path)
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.sampled_from(leaves(document)[1:]))
        inner: Any = document
        for key in place[:-1]:
            inner = inner[key]
        old = inner[place[-1]]
        is_number = isinstance(old, float) and data.draw(st.booleans())
        inner[place[-1]] = old * data.draw(FACTORS) if is_number else data.draw(VALUES)
    store.components_path.write_text(json.dumps(document), encoding="utf-8")
    state, note = store.restore(fresh())
    assert bool(note) == bool(list(tmp_path.glob("*.kept.json")))
    (window,) = windows(simulate_motor("sweep", 2.0, Faults(), seed=11), START + 30.0)
    _, reports = run(state, [window])
    assert not any(word in reports[0].to_json() for word in ("NaN", "Infinity"))


@SHORT
@given(st.data())
def test_whatever_a_file_contains_the_next_report_is_finite_and_nothing_raises(
    tmp_path: Path, data: st.DataObject
) -> None:
    check_changed(tmp_path, data)


@pytest.mark.full
@LONG
@given(st.data())
def test_whatever_many_files_contain_the_next_report_is_finite(tmp_path: Path, data: st.DataObject) -> None:
    check_changed(tmp_path, data)


def test_a_change_of_the_machine_file_keeps_the_components_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It was made deliberately, so that it is no warning; the log says in one line what becomes of the rest."""
    caplog.set_level(logging.INFO)
    store, document = saved(tmp_path)
    other = replace(PROBLEM, noise=(0.01, 0.02))
    initial = replace(fresh(), posterior=type(fresh().posterior).initial(other))
    state, note = store.restore(initial)
    assert [component.key for component in state.problem.components] == [UNBALANCE]
    assert not any(before.known for before in state.previous.values())
    assert note == ""
    (backup,) = tmp_path.glob("*.kept.json")
    (line,) = caplog.records
    assert line.levelno == logging.INFO
    assert_says(line.getMessage(), "machine file", "begin anew", "components", backup.name)
    assert json.loads(backup.read_text(encoding="utf-8")) == document


@pytest.mark.parametrize("approval", [Approval.OPEN, Approval.APPROVED])
def test_other_known_values_keep_only_what_somebody_approved(approval: Approval, tmp_path: Path) -> None:
    """A component that was found with the values of an example may explain nothing but them."""
    state = unbalanced()
    store = store_in(tmp_path)
    store.save(replace(state, adopted=tuple(replace(item, approval=approval) for item in state.adopted)))
    known = tuple((name, 1.1 * value) for name, value in PROBLEM.known)
    initial = replace(fresh(), posterior=type(fresh().posterior).initial(replace(PROBLEM, known=known)))
    warm, _ = store.restore(initial)
    kept = [component.key for component in warm.problem.components]
    assert kept == ([UNBALANCE] if approval is Approval.APPROVED else [])
    dropped = [event.id.partition("@")[0] for event in warm.health.dropped]
    assert dropped == ([] if approval is Approval.APPROVED else ["component/shaft/periodic"])
    assert all("machine file have changed" in (item.reason or "") for item in warm.health.dropped)


@pytest.mark.parametrize("factor", [1.0, 1.1], ids=["noise", "known values"])
def test_estimates_with_other_known_values_are_no_history_of_these(factor: float, tmp_path: Path) -> None:
    """The daemon that starts would see a trend from one to the other, and 'otolith baseline' the mean of both."""
    history = tuple((START + 2.0 * index, R_A, 1e-4) for index in range(40))
    store = store_in(tmp_path)
    store.save(replace(healthy(), health=HealthState(histories={"R_a": history})))
    known = tuple((name, factor * value) for name, value in PROBLEM.known)
    other = replace(PROBLEM, known=known, noise=(0.01, 0.02))
    warm, _ = store.restore(replace(fresh(), posterior=type(fresh().posterior).initial(other)))
    assert warm.health.histories == ({"R_a": history} if factor == 1.0 else {})


def test_files_of_version_1_are_read(tmp_path: Path) -> None:
    for path in KEPT.glob("*.json"):
        shutil.copy(path, tmp_path)
    store = store_in(tmp_path, "0123456789abcdef")
    state, note = store.restore(fresh())
    assert note == ""
    decisions = store.decisions()
    assert decisions == OperatorDecisions(
        frozenset({UNBALANCE}), frozenset({"shaft/Coulomb/omega"}), {"winding/linear/i": 1.7e9}
    )
    state = apply_decisions(state, decisions)
    assert [component.key for component in state.problem.components] == [UNBALANCE]
    torque = lambda _, angle, *__: 0.004 * math.sin(angle)  # noqa: E731 - as in the motor's faults
    state, reports = run(state, windows(simulate_motor("sweep", 8.0, Faults(torque=torque), seed=13), START + 60.0))
    assert holds_truth(reports[-1])
    store.save(state)
    assert json.loads(store.components_path.read_text(encoding="utf-8"))["version"] == 2
    assert store_in(tmp_path, "0123456789abcdef").restore(fresh())[0].adopted == state.adopted
    assert store_in(tmp_path, "of other signals").restore(fresh())[0].adopted == ()


def test_the_filter_and_events_of_an_earlier_version_2_are_read(tmp_path: Path) -> None:
    """A daemon of 2026-11-23, 08:00 wrote the file; its fingerprints were removed, so that the twin may change."""
    source = KEPT / "version-2" / "demo.dc-motor-in-process.json"
    shutil.copy(source, tmp_path)
    machine = load_machine(EXAMPLES / "dc-motor-in-process.toml", with_driver=False)
    names = machine.file.machine
    store = StateStore(names.site, names.name, machine.twin, tmp_path)
    cold = initial_state(names.name, names.site, machine.problem, machine.plan)
    state, note = store.restore(cold)
    assert note == ""
    assert [known.component.key for known in state.adopted] == ["shaft/periodic/t"]
    assert {event.id for event in state.health.open_events} == {
        "limit/R_a@1795452938.2",
        "component/shaft/periodic@1795452821.2",
    }
    assert state.posterior.belief.end == pytest.approx(1_795_452_960.2, abs=0.1)
    store.save(state)
    again, note = store.restore(cold)
    assert note == ""
    assert again.posterior.belief.end == state.posterior.belief.end


def test_a_state_that_is_not_plausible_is_not_saved(tmp_path: Path) -> None:
    store, document = saved(tmp_path)
    state = unbalanced()
    belief = state.posterior.belief
    for wrong in (
        replace(belief, mean=np.full_like(belief.mean, np.nan)),
        replace(belief, mean=belief.mean + 1e3),
        replace(belief, covariance=-belief.covariance),
    ):
        with pytest.raises(OtolithError, match="kept as it was"):
            store.save(replace(state, posterior=replace(state.posterior, belief=wrong)))
    assert json.loads(store.components_path.read_text(encoding="utf-8")) == document


def test_a_refused_file_that_cannot_be_renamed_is_never_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    store, _ = saved(tmp_path)
    store.components_path.write_text("damaged", encoding="utf-8")
    monkeypatch.setattr(Path, "rename", refuse)
    _, note = store.restore(fresh())
    assert "cannot be renamed" in note
    with pytest.raises(OtolithError, match="not overwritten"):
        store.save(healthy())
    assert store.components_path.read_text(encoding="utf-8") == "damaged"


def test_a_parameter_is_reset_once_also_over_restarts(tmp_path: Path) -> None:
    decisions = OperatorDecisions(resets={"R_a": 5.0})
    state = apply_decisions(unbalanced(), decisions)
    assert not state.previous["R_a"].known
    assert state.previous["D"].known
    assert state.posterior.prior().covariance[0, 0] == pytest.approx((12.0 - 3.0) ** 2 / 12.0, rel=1e-6)
    assert state.posterior.prior().covariance[1, 1] == unbalanced().posterior.prior().covariance[1, 1]
    state, _ = run(state, windows(simulate_motor("sweep", 4.0, Faults(), seed=11), START + 26.0))
    warm = apply_decisions(restarted(state, tmp_path), decisions)
    assert warm.previous["R_a"].known
    assert not apply_decisions(warm, OperatorDecisions(resets={"R_a": 6.0})).previous["R_a"].known


def test_a_component_and_everything_are_reset() -> None:
    state = apply_decisions(unbalanced(), OperatorDecisions(resets={UNBALANCE: 5.0}))
    assert not state.problem.components
    assert not state.adopted
    assert state.previous["R_a"].known
    for make in STATES:
        state = apply_decisions(make(), OperatorDecisions(approved=frozenset({UNBALANCE}), resets={EVERYTHING: 5.0}))
        initial = apply_decisions(fresh(), OperatorDecisions(approved=frozenset({UNBALANCE})))
        assert state.problem == initial.problem
        assert state.posterior.belief.mean.tobytes() == initial.posterior.belief.mean.tobytes()
        assert not state.adopted
        assert (state.previous, state.approved) == (initial.previous, initial.approved)


def test_records_are_those_that_commissioning_keeps(tmp_path: Path) -> None:
    """Components saved alone are not subject to an earlier reset of everything."""
    store = store_in(tmp_path)
    store.operator.write(OperatorDecisions(resets={EVERYTHING: 5.0}))
    store.save_components(component_records(unbalanced()))
    state = apply_decisions(store.restore(fresh())[0], store.decisions())
    assert [component.key for component in state.problem.components] == [UNBALANCE]


def test_a_history_that_an_older_file_kept_apart_while_its_clock_was_set_back_goes_on() -> None:
    history, short = [[START + at, 6.5, 1e-4] for at in range(30)], [[10.0, 6.5, 1e-4]]
    content = learned_state(healthy(), "").model_dump(mode="json")
    content["health"] |= {"histories": {"R_a": short, "D": short}, "earlier": {"R_a": [10.0, history]}}
    histories = LearnedState.model_validate(content).health.histories
    assert [len(histories[name]) for name in ("R_a", "D")] == [30, 1]
    content["health"]["earlier"] = 5
    with pytest.raises(ValueError, match="earlier"):
        LearnedState.model_validate(content)
