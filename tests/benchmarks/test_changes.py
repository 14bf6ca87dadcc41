"""The benchmark of changes: its machines are those of the twins, its pairs are interchangeable, its commands run."""

import json
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.changes import classes, healthy, steps
from benchmarks.changes.__main__ import main
from benchmarks.changes.classes import Trial
from benchmarks.changes.machines import (
    DC_MOTOR,
    LAB_MOTOR,
    LIBRARY_PLANTS,
    ONE_MASS,
    REVERSING_MOTOR,
    in_twin_units,
    problem_of,
    twin_of,
)
from benchmarks.changes.observe import Case, observe
from benchmarks.changes.plants import HEALTHY, Change, Plant, Term, generator, simulate
from click.testing import CliRunner

from otolith.acquisition.window import Array
from otolith.estimation.problem import Component, Problem, augment
from otolith.machine import library_twins
from otolith.twin.kernel import Excitation, kernel_of
from otolith_drivers.units import to_base

pytestmark = pytest.mark.full  # they test the benchmarks, not the product

ROOT = Path(__file__).parents[2]
PLANTS = {**LIBRARY_PLANTS, "lab_motor": LAB_MOTOR, "one_mass": ONE_MASS, "reversing": REVERSING_MOTOR}
OF_THE_NOISE = 0.03  # difference between plant and twin: far below what a window shows
SITES = {(name, site) for name in LIBRARY_PLANTS for site in (own.name for own in twin_of(PLANTS[name]).sites)}


def predicted(problem: Problem, plant: Plant, rows: Mapping[str, Array], values: Mapping[str, float]) -> Array:
    """Outputs (records, outputs) of the twin from the start of the plant, with such values of parameters."""
    twin = problem.twin
    given = dict(problem.known) | {free.name: free.nominal for free in problem.free} | dict(values)
    parameters = np.array([given.get(parameter.name, parameter.nominal) for parameter in twin.parameters])
    states = zip(plant.initial.values(), problem.base_model.states, strict=True)
    initial = np.zeros(len(twin.states))  # an augmented twin has the angle of the shaft as well
    initial[: len(plant.initial)] = [value / to_base(state.unit)[0] for value, state in states]
    still = np.zeros((1, plant.records))  # the inputs that an augmented twin adds: a constant has none
    drive = Excitation.uniform(np.column_stack([rows.get(own.name, still)[0] for own in twin.inputs]), plant.period)
    kernel, noise = kernel_of(twin), np.array(problem.noise)
    drive = replace(drive, substeps=kernel.substeps(parameters, initial, drive, 1e-3 * noise))
    outputs: Array = kernel.simulate(parameters[None], initial[None], drive)[0]
    return outputs


def difference(problem: Problem, rows: Mapping[str, Array], outputs: Array) -> float:
    """Largest difference of any output over its noise, root mean square."""
    shown = np.column_stack([rows[output.name][0] for output in problem.twin.outputs])
    return float(np.sqrt(np.mean((shown - outputs) ** 2, axis=0) / np.array(problem.noise) ** 2).max())


def recorded(plant: Plant, change: Change = HEALTHY) -> dict[str, Array]:
    return simulate(plant, [generator(1, plant.name, 0)], plant.records, change, change, 0)


def test_every_twin_of_the_library_has_a_machine() -> None:
    assert set(LIBRARY_PLANTS) == set(library_twins())


@pytest.mark.parametrize("name", sorted(PLANTS))
def test_a_machine_is_that_of_its_twin(name: str) -> None:
    plant = PLANTS[name]
    problem, rows = problem_of(plant), recorded(plant)
    true = {free.name: in_twin_units(problem.twin, free.name, plant.parameters[free.name]) for free in problem.free}
    assert difference(problem, rows, predicted(problem, plant, rows, true)) < OF_THE_NOISE


@pytest.mark.parametrize("place", sorted(SITES))
def test_a_term_enters_the_machine_where_it_enters_the_twin(place: tuple[str, str]) -> None:
    name, site = place
    plant = PLANTS[name]
    size = {"pipe": 5e3, "carriage": 2.0, "force": 100.0, "flow": 1e-4, "winding": 0.3}.get(site, 0.1)
    size = 0.05 if next(own for own in twin_of(plant).sites if own.name == site).mode == "multiplicative" else size
    size *= 0.05 if plant.name.startswith("dc_motor") else 1.0
    rows = recorded(plant, Change(terms={site: Term("constant", amplitude=size)}))
    problem = problem_of(plant)
    true = {free.name: in_twin_units(problem.twin, free.name, plant.parameters[free.name]) for free in problem.free}
    wider = augment(problem, [Component(site, "constant", "", size)])
    assert difference(wider, rows, predicted(wider, plant, rows, {**true, "_amplitude_0": size})) < OF_THE_NOISE
    assert difference(problem, rows, predicted(problem, plant, rows, true)) > 30.0 * OF_THE_NOISE


MOVED_PAIRS = [trial for trial in classes.trials(6, 6) if trial.is_class and trial.members[0].reason == "PARAMETER"]


@pytest.mark.parametrize(
    "trial",
    [trial for trial in MOVED_PAIRS if trial.case.after.gains],
    ids=lambda trial: trial.case.name,
)
def test_what_a_wrong_sensor_shows_is_what_the_twin_predicts_with_moved_parameters(trial: Trial) -> None:
    plant = trial.case.plant
    rows, problem = recorded(plant, trial.case.after), trial.case.problem
    moved = next(own for own in MOVED_PAIRS if own.pair == trial.pair and own.case.after.parameters)
    values = {
        free.name: in_twin_units(
            problem.twin, free.name, {**plant.parameters, **moved.case.after.parameters}[free.name]
        )
        for free in problem.free
    }
    gains = trial.case.after.gains
    start = {name: value * gains.get(name, 1.0) for name, value in plant.initial.items()}
    shown = replace(plant, initial=start)
    assert difference(problem, rows, predicted(problem, shown, rows, values)) < OF_THE_NOISE


def test_a_sensor_shows_its_gain_and_offset() -> None:
    change = Change(gains={"i": 1.1}, offsets={"omega": 2.0})
    right, wrong = recorded(DC_MOTOR), recorded(DC_MOTOR, change)
    assert wrong["i"] == pytest.approx(1.1 * right["i"])
    assert wrong["omega"] == pytest.approx(right["omega"] + 2.0)
    assert (wrong["V_a"] == right["V_a"]).all()


def test_runs_that_are_simulated_together_are_those_simulated_alone() -> None:
    case = Case("two", DC_MOTOR, Change(parameters={"R_a": 7.0}), healthy=1, changed=1)
    together, alone = observe(case, [3, 4], 1), observe(case, [4], 1)
    assert together[1] == alone[0]


def checked(code: int, output: str, errors: str) -> str:
    """The output of a command that ends as it should."""
    assert code in (0, 1), errors
    assert re.fullmatch(r"(\d+ of \d+ parts\n)+", errors), errors
    return output


def printed_by_a_process(*arguments: str) -> str:
    command = [sys.executable, "-m", "benchmarks.changes", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=3600, check=False)
    return checked(done.returncode, done.stdout, done.stderr)


def run(*arguments: str) -> Any:
    """What a command prints in this process, which has loaded the kernels."""
    done = CliRunner().invoke(main, [*arguments, "--processes", "1", "--json"], catch_exceptions=False)
    return json.loads(checked(done.exit_code, done.stdout, done.stderr))


def test_classes_prints_what_the_reports_state() -> None:
    (own,) = run("classes", "T_load reads", "--runs", "1", "--healthy", "4", "--changed", "4")
    assert own["expected"] == "class"
    assert own["met"], own
    assert sum(own["statuses"]["R_a"].values()) == 4


def test_steps_prints_how_often_intervals_hold_the_truth() -> None:
    (own,) = run("steps", "dc_motor: R_a +20%", "--runs", "1", "--healthy", "4", "--changed", "4")
    assert own["met"], own
    assert own["held"] == 1.0


def test_healthy_prints_adoptions_and_verdicts() -> None:
    (own,) = run("healthy", "dc_motor: ripple", "--runs", "1", "--windows", "5")
    assert own["met"], own
    assert own["windows"] == 5


def test_calibration_prints_a_table() -> None:
    document = run("calibration", "--runs", "1")
    assert len(document["cases"]) == 1
    assert sum(own["count"] for own in document["decisions"]) == 1


def test_reports_are_the_same_in_every_run(tmp_path: Path) -> None:
    before = tmp_path / "before.json"
    before.write_text(json.dumps(run("reports", "step of R_a")))
    assert "the same" in printed_by_a_process("reports", "step of R_a", "--against", str(before), "--processes", "2")


def test_interchangeable_changes_are_stated_as_classes() -> None:
    pairs = ("k_v /", "T_load", "K, J, T_c", "brush drop", "R_a, L_a")
    assert [own["truth"] for own in run("classes", *pairs, "--runs", "3", "--healthy", "6") if not own["met"]] == []


def test_steps_of_parameters_are_followed() -> None:
    machines = ("dc_motor:", "servo_axis:", "two_mass:")
    assert [own["case"] for own in run("steps", *machines, "--runs", "2", "--healthy", "6") if not own["met"]] == []


def test_nothing_is_adopted_on_healthy_machines() -> None:
    documents = run("healthy", "dc_motor", "--runs", "2", "--windows", "22")
    assert sum(own["adopted"] for own in documents) == 0


def test_a_step_of_each_estimated_parameter_is_a_case() -> None:
    names = {f"{plant.name}: {free.name}" for plant in LIBRARY_PLANTS.values() for free in problem_of(plant).free}
    made = steps.steps(6, 6)
    assert {step.case.name.rpartition(" ")[0] for step in made} == names
    assert len(made) == 2 * len(names)


@pytest.mark.parametrize("name", ["dc_motor", "pump", "two_mass"])
def test_a_ripple_has_the_effect_that_it_should(name: str) -> None:
    """Two windows of another operation than that from which its size is computed."""
    (ripple,) = healthy.cases(2, [f"{name}: ripple"])
    plant = ripple.plant
    right, rippled = (
        simulate(plant, [generator(2, name, 1)], 2 * plant.records, own, own, 0) for own in (HEALTHY, ripple.before)
    )
    effects = [(rippled[own.name] - right[own.name]) / own.noise for own in twin_of(plant).outputs]
    assert sum(float(np.sum(own**2)) for own in effects) / 2.0 == pytest.approx(healthy.RIPPLE, rel=0.2)
