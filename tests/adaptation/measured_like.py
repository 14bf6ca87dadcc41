"""Plants with what measured records have and twins lack: limits of sensors, ripple, coarse encoders, wandering load.

They are integrated here, apart from the kernels of the twins.
"""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.problem import Problem
from otolith.health.schema import FindingKind, ReportDocument, Status
from otolith.machine import find_twin

MOTOR = find_twin("dc_motor")
TRUTH = {parameter.name: parameter.nominal for parameter in MOTOR.parameters}
SIGNALS = ("V_a", "T_load", "i", "omega")
NOISE = (0.005, 0.02)  # A, rad/s
RECORDS, PERIOD, SUBSTEPS = 200, 0.01, 20
LEVELS = (8.0, 22.0)  # V: magnitude of the set-points
HELD = (40, 160)  # records for which one is held
WANDER = 20.0  # s: time constant of a load torque that wanders
ALIASED = 3e-3  # relative: deviation of a ripple from its nominal frequency, which the sampling turns into a slow beat


@dataclass(frozen=True)
class Imperfections:
    """What the sensors and the supply of a motor do that the twin does not know."""

    limit: float = 0.0
    """A: the current sensor reads no more, but for its noise; 0 for none."""
    limit_noise: float = 0.005
    """A: standard deviation of what it reads at the limit."""
    first: int = 0
    """Window from which on it has the limit."""
    current_ripple: float = 0.0
    """A: amplitude at the current sensor."""
    supply_ripple: float = 0.0
    """V: amplitude at the armature."""
    frequency: float = 100.0
    """Hz: of both."""
    encoder_step: float = 0.0
    """rad/s: 0 for none."""
    wandering_load: float = 0.0
    """N*m: standard deviation of a load torque that is not measured."""


def settled_windows(seed: int, count: int, scatter: float) -> list[Window]:
    """Return windows of a motor at constant voltage of which only the speed is measured, by counts of an encoder.

    The speed reads ``scatter`` (rad/s) too much in one period and too little in the next, in steps of a count.
    """
    random, total = np.random.default_rng(seed), count * RECORDS
    system, drive = _motor_matrices()
    slow = -1.0 / np.linalg.eigvals(system).real.max()
    speed = np.linalg.solve(system, -drive @ (LEVELS[1], 0.0))[1] * -np.expm1(-PERIOD * np.arange(total) / slow)
    turns = np.cumsum(random.random(total) < 0.9)  # one period in ten has the same sign as the one before
    counted = np.rint(speed / (0.4 * scatter) + 2.5 * (-1.0) ** turns) * 0.4 * scatter
    values = np.column_stack([np.full(total, LEVELS[1]), np.zeros(total), counted])
    return cut(("V_a", "T_load", "omega"), values, RECORDS, PERIOD)


def motor_windows(seed: int, count: int, have: Imperfections) -> list[Window]:
    """Return windows of a DC motor with random steps of its voltage."""
    random, total, step = np.random.default_rng(seed), count * RECORDS, PERIOD / SUBSTEPS
    frequency, phase = have.frequency * (1.0 + random.uniform(-ALIASED, ALIASED)), random.uniform(0.0, 2.0 * np.pi)
    decay, spread = np.exp(-step / WANDER), have.wandering_load * np.sqrt(-np.expm1(-2.0 * step / WANDER))
    state, load, level, left = np.zeros(2), 0.0, 0.0, 0
    values, parts = np.empty((total, len(SIGNALS))), np.arange(SUBSTEPS) * step
    for record in range(total):
        if not left:
            left, level = int(random.integers(*HELD)), random.uniform(*LEVELS) * random.choice([-1.0, 1.0])
        left -= 1
        ripple = have.current_ripple * np.sin(2.0 * np.pi * frequency * record * PERIOD + phase)
        values[record] = level, 0.0, *_read(state, random, have, record, ripple)
        supplied = have.supply_ripple * np.sin(2.0 * np.pi * frequency * (record * PERIOD + parts) + phase)
        loads = [load := decay * load + change for change in (spread * random.normal(size=SUBSTEPS)).tolist()]
        state = _moved(state, (level + supplied).tolist(), loads)
    return cut(SIGNALS, values, RECORDS, PERIOD)


def _moved(state: Array, voltages: list[float], loads: list[float]) -> Array:
    """Return current and speed after a record, by steps of the midpoint rule."""
    (own, cross), (back, damping) = _STEP.tolist()
    (supply, brake), (driven, braked) = _DRIVEN.tolist()
    current, speed = state.tolist()
    for voltage, load in zip(voltages, loads, strict=True):
        current, speed = (
            own * current + cross * speed + supply * voltage + brake * load,
            back * current + damping * speed + driven * voltage + braked * load,
        )
    return np.array([current, speed])


def _motor_matrices() -> tuple[Array, Array]:
    r_a, l_a, j, k_e, k_t, d = (TRUTH[name] for name in ("R_a", "L_a", "J", "K_e", "K_t", "D"))
    return np.array([[-r_a / l_a, -k_e / l_a], [k_t / j, -d / j]]), np.array([[1.0 / l_a, 0.0], [0.0, -1.0 / j]])


def _midpoint(step: float) -> tuple[Array, Array]:
    """Return what a step of the midpoint rule makes of the state and of the inputs."""
    system, drive = _motor_matrices()
    return np.eye(2) + step * system + 0.5 * step**2 * system @ system, step * drive + 0.5 * step**2 * system @ drive


_STEP, _DRIVEN = _midpoint(PERIOD / SUBSTEPS)


def _read(
    state: Array, random: np.random.Generator, have: Imperfections, record: int, ripple: float
) -> tuple[float, float]:
    """Return what the sensors of current and speed read; ``ripple`` is the one at the current sensor."""
    current, speed = state + np.array(NOISE) * random.normal(size=2)
    limited = have.limit and record >= have.first * RECORDS and abs(state[0]) > have.limit
    if limited:
        current = np.sign(state[0]) * have.limit + have.limit_noise * random.normal()
    current += ripple
    if have.encoder_step:
        speed = have.encoder_step * np.rint(state[1] / have.encoder_step)
    return float(current), float(speed)


def cut(signals: tuple[str, ...], values: Array, records: int, period: float) -> list[Window]:
    """Return the windows of a record."""
    parts = [values[start : start + records] for start in range(0, len(values) - records + 1, records)]
    return [Window.whole(at, at * records * period, period, signals, part) for at, part in enumerate(parts)]


def motor_problem(*free: str, sensors: tuple[str, ...] = ("i", "omega")) -> Problem:
    """Return the problem of the motor whose other parameters are known, with some of its ``sensors``."""
    known = tuple((row.name, row.nominal) for row in MOTOR.parameters if row.name not in free)
    rows = [(output, level) for output, level in zip(MOTOR.outputs, NOISE, strict=True) if output.name in sensors]
    twin = replace(MOTOR, name=f"dc_motor_{'_'.join(sensors)}", outputs=tuple(output for output, _ in rows))
    unknown = tuple(row for row in MOTOR.parameters if row.name in free)
    return Problem(
        MOTOR if twin.outputs == MOTOR.outputs else twin, known, unknown, noise=tuple(level for _, level in rows)
    )


def reports(problem: Problem, windows: list[Window]) -> list[ReportDocument]:
    """Return the reports of ``windows``."""
    state, documents = initial_state("motor", "bench", problem), []
    for window in windows:
        state, report = adapt(state, window)
        documents.append(report.document)
    return documents


def blamed(documents: list[ReportDocument]) -> set[str]:
    """Return which sensors and late signals were named as faulty, and which components were adopted."""
    faults = {
        finding.subject
        for document in documents
        for finding in document.findings
        if finding.kind in (FindingKind.SENSOR, FindingKind.TIMING)
    }
    return faults | {component.id for document in documents for component in document.components}


def coverage(documents: list[ReportDocument], truth: dict[str, float], first: int) -> tuple[int, int]:
    """Return in how many published intervals of explained windows from ``first`` on the truth lies, and of how many."""
    inside = published = 0
    for document in documents[first:]:
        for name, parameter in document.parameters.items():
            is_explained = document.fit is None or document.fit.explained
            if parameter.status is Status.ESTIMATED and is_explained:
                assert parameter.low is not None
                assert parameter.high is not None
                published += 1
                inside += parameter.low <= truth[name] <= parameter.high
    return inside, published
