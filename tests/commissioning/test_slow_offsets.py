"""An offset that grows slowly is told from parameters that move, by windows at several operating points together."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.diagnosis import machine_of
from benchmarks.everyday import ONSET, PERIOD, RECORDS, RESISTANCE, SITUATIONS, Machine, Situation, run_of, simulate

from otolith.acquisition.window import Window
from otolith.commissioning.slow_offsets import MAX_BLOCKS, MIN_BLOCKS, OffsetLedger, SlowChange
from otolith.discovery.linear_response import LinearResponse
from otolith.estimation.posterior import Posterior
from otolith.estimation.window_fit import fit_predicted
from otolith.twin.components import sites
from tests.variants import often

MOTOR = machine_of("motor").problem


def situation(name: str) -> Situation:
    return next(item for item in SITUATIONS if name in item.name)


def ledger_of(machine: Machine, seconds: float, seed: int = 1) -> OffsetLedger:
    """The ledger after windows that are each estimated alone."""
    names, values = simulate(machine, seconds, seed)
    ledger, start = OffsetLedger(), Posterior.initial(MOTOR)
    for index in range(len(values) // RECORDS):
        rows = values[index * RECORDS : (index + 1) * RECORDS]
        window = Window.whole(index, index * RECORDS * PERIOD, PERIOD, names, rows)
        fitted = fit_predicted(start.predict(window), MOTOR, window).linearised_at_end()
        ledger = ledger.after(LinearResponse(fitted), fitted.inflation)
    return ledger


def places(change: SlowChange | None) -> set[str]:
    return {sites(MOTOR.base_model)[own.site].name for own in change.offsets} if change else set()


@pytest.mark.parametrize("seeds", often([(1,)], [(1,), (1, 2, 3, 4)]))
@pytest.mark.parametrize(
    ("name", "verdict"),
    [
        ("zero of the current", "right"),
        ("zero of the speed", "right"),
        ("zero of the load", "honest"),
        ("load without a sensor that rises", "honest"),
        ("one after another", "right"),
    ],
)
def test_what_drifts_is_named_and_the_parameters_stay_known(name: str, verdict: str, seeds: tuple[int, ...]) -> None:
    """A load that rises and a zero of its sensor are a class: no data tell them apart."""
    outcomes = [run_of(situation(name), seed) for seed in seeds]
    assert [outcome.verdict for outcome in outcomes] == [verdict] * len(seeds), outcomes
    assert sum(outcome.covered for outcome in outcomes) >= 0.85 * sum(outcome.intervals for outcome in outcomes)


def test_a_speed_that_a_controller_holds_is_not_clipped_at_its_set_point() -> None:
    """What an open test explains is no limit of a sensor."""
    outcome = run_of(situation("load without a sensor that rises"), 2)
    assert outcome.verdict == "honest", outcome.story


def test_windows_together_give_the_growth_and_the_parameters_beside_it() -> None:
    rate = 0.05 / 60.0
    change = ledger_of(situation("zero of the current").machine, 64.0).change()
    assert places(change) == {"sensor of i"}
    best = change.offsets[0] if change else None
    assert best is not None
    truth = np.array([RESISTANCE / MOTOR.scale[0], rate * 24.0, rate])
    assert np.all(np.abs(best.values[[0, -2, -1]] - truth) < 4.0 * best.sd[[0, -2, -1]])
    assert abs(best.onset - ONSET) <= 4.0


@pytest.mark.parametrize(
    "machine",
    [
        Machine(),
        Machine(resistance=lambda time: RESISTANCE * (0.93 + 0.07 * float(np.exp(-time / 60.0)))),
        Machine(resistance=lambda time: RESISTANCE * (0.9 if time > ONSET else 1.0)),
        Machine(damping=lambda time: 0.00143 * (1.0 + 0.01 * time)),
    ],
)
def test_parameters_that_stay_drift_or_jump_are_no_offset(machine: Machine) -> None:
    assert ledger_of(machine, 80.0).change() is None


def test_one_operating_point_shows_no_offset() -> None:
    """There an offset of a current and other parameters are the same."""
    drifting = replace(situation("zero of the current").machine, speed=lambda _: 12.0)
    assert ledger_of(drifting, 80.0).change() is None


def test_old_windows_are_pooled() -> None:
    ledger = ledger_of(Machine(), 160.0)
    assert len(ledger.blocks) == MAX_BLOCKS
    assert sum(block.windows for block in ledger.blocks) == 80
    assert [block.windows for block in ledger.blocks[-4:]] == [1, 1, 1, 1]


def test_windows_that_nothing_explains_are_dropped() -> None:
    jumped = ledger_of(Machine(resistance=lambda time: RESISTANCE * (0.9 if time > ONSET else 1.0)), 60.0)
    assert len(jumped.without_other_changes().blocks) == MIN_BLOCKS
    assert ledger_of(Machine(), 40.0).without_other_changes().blocks
