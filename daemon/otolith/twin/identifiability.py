"""What could be estimated at all: the structural check of a twin, by the rank of its sensitivities.

Over random excitation and random parameters near the nominal ones, a parameter whose sensitivity is a combination of
the others' can be estimated in no experiment of this kind, whatever the noise (local structural identifiability, tested
numerically; E. Walter, L. Pronzato, Identification of Parametric Models from Experimental Data, 1997, chapter 2).
"""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.definition import Definition
from otolith.twin.kernel import Excitation, kernel_of

RECORDS, TRIALS = 300, 3
PERIODS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)  # s: one of them suits the machine's time constants
THRESHOLD_PERIOD = 1e-2  # s
SPREAD = 0.1  # of the bounds' width, around the nominal values
DEAD = "no output depends on it"
THRESHOLD = "it acts as a threshold only, without a slope that an estimation could follow"
NOT_FINITE = "the equations are not finite, or not smooth, around the nominal values and the initial state"
RESOLVED = 1e-4  # of an output's range: how little a finer step may change it
NOTHING = 1e-9  # of the longest sensitivity: as long as none at all
DEPENDENT = 1e-5  # of its own length: how much of a sensitivity must be its own
PARTNER = 0.05  # of the largest coefficient


@dataclass(frozen=True, slots=True)
class StructuralIdentifiability:
    """Of one parameter."""

    name: str
    identifiable: bool
    reason: str


def structure_of(definition: Definition, seed: int = 1) -> list[StructuralIdentifiability]:
    """Whether each parameter could be estimated if all of them and the initial state were unknown."""
    random = np.random.default_rng(seed)
    trials: list[list[StructuralIdentifiability]] = []
    for period in PERIODS:
        # Each at parameters of its own, judged alone: a combination that acts alone differs from point to point.
        found = [_sensitivities(definition, period, random) for _ in range(TRIALS)]
        trials += [
            [_judge(definition, columns, index) for index in range(len(definition.parameters))]
            for columns in found
            if np.isfinite(columns).all()
        ]
    if not trials:
        return [
            StructuralIdentifiability(entry.name, identifiable=False, reason=NOT_FINITE)
            for entry in definition.parameters
        ]
    best = max(trials, key=lambda found: sum(entry.identifiable - (entry.reason == DEAD) for entry in found))
    return [_unless_threshold(definition, entry) if entry.reason == DEAD else entry for entry in best]


def _sensitivities(definition: Definition, period: float, random: np.random.Generator) -> Array:
    """(records * outputs, parameters + states), each column per share of its range, each row per noise."""
    nominal = np.array([entry.nominal for entry in definition.parameters])
    low = np.array([entry.low for entry in definition.parameters])
    high = np.array([entry.high for entry in definition.parameters])
    parameters = np.clip(nominal + SPREAD * (high - low) * random.uniform(-0.5, 0.5, len(nominal)), low, high)
    initial = np.array([entry.initial for entry in definition.states])
    excitation = _excitation(definition, period, random)
    outputs, slopes, _, _ = kernel_of(definition).sensitivities(parameters, initial, excitation)
    finer = kernel_of(definition).simulate(parameters[None], initial[None], replace(excitation, substeps=16))[0]
    with np.errstate(over="ignore", invalid="ignore"):
        resolved = np.abs(outputs - finer).max(axis=0) <= RESOLVED * np.ptp(finer, axis=0)
    if not resolved.all():  # a step too long for the machine: what comes out is the integrator's, not the equations'
        return np.full((1, 1), np.nan)
    widths = np.concatenate([high - low, [entry.high - entry.low for entry in definition.states]])
    noise = np.array([entry.noise for entry in definition.outputs])
    with np.errstate(over="ignore", invalid="ignore"):
        found: Array = (slopes * widths / noise[None, :, None]).reshape(-1, len(widths))
    return found


def _unless_threshold(definition: Definition, entry: StructuralIdentifiability) -> StructuralIdentifiability:
    """A parameter without a slope may still act, as the threshold of a ``where``."""
    excitation = _excitation(definition, THRESHOLD_PERIOD, np.random.default_rng(1))
    initial = np.array([[state.initial for state in definition.states]])
    outputs = []
    for value in (definition.parameter(entry.name).low, definition.parameter(entry.name).high):
        parameters = [value if e.name == entry.name else e.nominal for e in definition.parameters]
        outputs.append(kernel_of(definition).simulate(np.array([parameters]), initial, excitation))
    acts = not np.array_equal(outputs[0], outputs[1], equal_nan=True)
    return StructuralIdentifiability(entry.name, identifiable=False, reason=THRESHOLD) if acts else entry


def _excitation(definition: Definition, period: float, random: np.random.Generator) -> Excitation:
    columns = [_telegraph(entry.low, entry.high, random) for entry in definition.inputs]
    return Excitation(np.column_stack([np.zeros((RECORDS, 0)), *columns]), period, substeps=8)


def _telegraph(low: float, high: float, random: np.random.Generator) -> Array:
    """(records,): random levels, each held for a random while."""
    levels = random.uniform(low, high, RECORDS)
    changes = np.cumsum(random.random(RECORDS) < 0.05)
    return np.asarray(levels[changes])


def _judge(definition: Definition, columns: Array, index: int) -> StructuralIdentifiability:
    name = definition.parameters[index].name
    lengths = np.linalg.norm(columns, axis=0)
    if lengths[index] <= NOTHING * lengths.max():
        return StructuralIdentifiability(name, identifiable=False, reason=DEAD)
    unit = columns / np.where(lengths > 0.0, lengths, 1.0)
    others = np.delete(unit, index, axis=1)
    shares, *_ = np.linalg.lstsq(others, unit[:, index], rcond=1e-12)
    if np.linalg.norm(unit[:, index] - others @ shares) > DEPENDENT:
        return StructuralIdentifiability(name, identifiable=True, reason="")
    names = [entry.name for entry in definition.parameters] + [f"initial {entry.name}" for entry in definition.states]
    del names[index]
    weights = abs(shares)
    partners = [other for other, weight in zip(names, weights, strict=True) if weight > PARTNER * weights.max()]
    return StructuralIdentifiability(name, identifiable=False, reason=f"only together with {', '.join(partners)}")
