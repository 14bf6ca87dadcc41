"""Structural identifiability of a twin, tested numerically by the rank of its output sensitivities.

Under random excitation and random parameters near the nominal ones, a parameter whose sensitivity is a linear
combination of the others' cannot be estimated in any such experiment, whatever the noise (local structural
identifiability; E. Walter, L. Pronzato, Identification of Parametric Models from Experimental Data, 1997, chapter 2).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.definition import Definition, Role
from otolith.twin.kernel import Excitation, Kernel, kernel_of

# Decisions. docs/reference/thresholds-twin.md gives the origin of each and the test that guards it.
RECORDS, TRIALS = 300, 3
CHANGE_PROBABILITY = 0.05  # per record, of the random input levels: 15 changes in an experiment
PERIODS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)  # s: one of them suits the machine's time constants
THRESHOLD_PERIOD = 1e-2  # s
SUBSTEPS, FINER_SUBSTEPS = 8, 16
SETTLING_ROUNDS = 3  # experiments of each period in which a machine settles at constant inputs
PARAMETER_SPREAD = 0.1  # of the width of the bounds, around the nominal values
MAX_STEP_ERROR = 1e-4  # of an output's range: change of the prediction between the two numbers of substeps
MIN_SENSITIVITY = 1e-9  # of the largest column norm: below it no output depends on the parameter
MIN_INDEPENDENT_PART = 1e-5  # of a column's norm: the part that no combination of other columns explains

DEAD = "no output depends on it"
AMONG_SEVERAL = "several combinations of the others act as it does"
THRESHOLD = "it acts as a threshold only, without a slope that an estimation could follow"
NOT_FINITE = "the equations are not finite, or not smooth, around the nominal values and the initial state"


@dataclass(frozen=True, slots=True)
class StructuralIdentifiability:
    """Whether one parameter can be estimated, and why not."""

    name: str
    identifiable: bool
    reason: str  # Empty if it can be estimated


def structural_identifiability(
    definition: Definition, seed: int = 1, *, settled: bool = False
) -> list[StructuralIdentifiability]:
    """Whether each parameter could be estimated beside those whose role is estimated, and the initial state.

    The others are given, as without a machine file that says otherwise. With ``settled``, inputs are constant and the
    machine is where they have brought it, as at one set-point.
    """
    random = np.random.default_rng(seed)
    trials: list[list[StructuralIdentifiability]] = []
    for period in PERIODS:
        # Each trial is judged alone: a combination that acts as one parameter differs from point to point.
        trials += [
            [_judge(definition, columns, index) for index in range(len(definition.parameters))]
            for columns in (_sensitivities(definition, period, random, settled=settled) for _ in range(TRIALS))
            if np.isfinite(columns).all()
        ]
    if not trials:
        return [_not_identifiable(parameter.name, NOT_FINITE) for parameter in definition.parameters]
    best = max(trials, key=lambda trial: sum(result.identifiable - (result.reason == DEAD) for result in trial))
    return [
        _not_identifiable(result.name, THRESHOLD)
        if result.reason == DEAD and not settled and _acts_as_threshold(definition, result.name)
        else result
        for result in best
    ]


def _not_identifiable(name: str, reason: str) -> StructuralIdentifiability:
    return StructuralIdentifiability(name, identifiable=False, reason=reason)


def _sensitivities(definition: Definition, period: float, random: np.random.Generator, *, settled: bool) -> Array:
    """(records * outputs, parameters + states), each column per width of its bounds, each row per noise.

    NaN if the integrator's step is too long for the machine: the sensitivities would be those of the integrator.
    """
    kernel, parameters = kernel_of(definition), definition.parameters
    nominal = np.array([parameter.nominal for parameter in parameters])
    low = np.array([parameter.low for parameter in parameters])
    high = np.array([parameter.high for parameter in parameters])
    values = np.clip(nominal + PARAMETER_SPREAD * (high - low) * random.uniform(-0.5, 0.5, len(nominal)), low, high)
    initial = np.array([state.initial for state in definition.states])
    excitation = _excitation(definition, period, random)
    if settled:
        excitation = replace(excitation, inputs=np.repeat(excitation.inputs[:1], RECORDS, axis=0))
        initial = _settled(kernel, values, initial, excitation.inputs)
    outputs, slopes, _, _ = kernel.sensitivities(values, initial, excitation)
    finer = kernel.simulate(values[None], initial[None], replace(excitation, substeps=FINER_SUBSTEPS))[0]
    widths = np.concatenate([high - low, [state.high - state.low for state in definition.states]])
    noise = np.array([output.noise for output in definition.outputs])
    with np.errstate(over="ignore", invalid="ignore"):
        resolved = np.abs(outputs - finer).max(axis=0) <= MAX_STEP_ERROR * np.maximum(np.ptp(finer, axis=0), noise)
        columns = (slopes * widths / noise[None, :, None]).reshape(-1, len(widths))
    return columns if resolved.all() else np.full((1, 1), np.nan)


def _settled(kernel: Kernel, values: Array, initial: Array, inputs: Array) -> Array:
    """Return the state (states,) to which constant ``inputs`` bring the machine, with longer and longer steps."""
    for period in np.repeat(PERIODS, SETTLING_ROUNDS):
        coarse, fine = (
            kernel.sensitivities(values, initial, Excitation.uniform(inputs, period, substeps), []).last
            for substeps in (SUBSTEPS, FINER_SUBSTEPS)
        )
        if not np.allclose(coarse, fine, rtol=MAX_STEP_ERROR, atol=0.0):
            break
        initial = fine
    return initial


def _acts_as_threshold(definition: Definition, name: str) -> bool:
    """Whether the outputs differ between the bounds of a parameter that has no slope, as in a ``where``."""
    excitation = _excitation(definition, THRESHOLD_PERIOD, np.random.default_rng(1))
    initial = np.array([[state.initial for state in definition.states]])
    outputs = []
    for value in (definition.parameter(name).low, definition.parameter(name).high):
        values = [value if parameter.name == name else parameter.nominal for parameter in definition.parameters]
        outputs.append(kernel_of(definition).simulate(np.array([values]), initial, excitation))
    return not np.array_equal(outputs[0], outputs[1], equal_nan=True)


def _excitation(definition: Definition, period: float, random: np.random.Generator) -> Excitation:
    """Random levels of each input within its range, each held for a random number of records."""
    columns = [np.zeros((RECORDS, 0))]
    for driven in definition.inputs:
        levels = random.uniform(driven.low, driven.high, RECORDS)
        columns.append(levels[np.cumsum(random.random(RECORDS) < CHANGE_PROBABILITY)][:, None])
    return Excitation.uniform(np.hstack(columns), period, SUBSTEPS)


def _judge(definition: Definition, columns: Array, index: int) -> StructuralIdentifiability:
    """Whether the column of a parameter is long enough and independent of those of the unknown numbers."""
    parameters = definition.parameters
    name = parameters[index].name
    lengths = np.linalg.norm(columns, axis=0)
    if lengths[index] <= MIN_SENSITIVITY * lengths.max():
        return _not_identifiable(name, DEAD)
    unit = columns / np.where(lengths > 0.0, lengths, 1.0)
    states = range(len(parameters), unit.shape[1])
    estimated = [at for at, parameter in enumerate(parameters) if parameter.role is Role.ESTIMATED and at != index]
    others = [*estimated, *states]
    if _independent_part(unit, index, others) > MIN_INDEPENDENT_PART:
        return StructuralIdentifiability(name, identifiable=True, reason="")
    names = [parameter.name for parameter in parameters] + [f"initial {state.name}" for state in definition.states]
    partners = [
        names[other]
        for other in others
        if _independent_part(unit, index, [at for at in others if at != other]) > MIN_INDEPENDENT_PART
    ]
    return _not_identifiable(name, f"only together with {', '.join(partners)}" if partners else AMONG_SEVERAL)


def _independent_part(unit: Array, index: int, others: Sequence[int]) -> float:
    """Return the norm of what no combination of the columns ``others`` explains of the column ``index``."""
    columns = unit[:, list(others)]
    shares, *_ = np.linalg.lstsq(columns, unit[:, index], rcond=1e-12)
    return float(np.linalg.norm(unit[:, index] - columns @ shares))
