"""Twelve typical components, and their records with a given sensor noise."""

from dataclasses import dataclass

import numpy as np

from benchmarks.discovery.motor import SIGNALS, Faults, simulate_motor
from benchmarks.discovery.truth import SHAFT, SOURCES, WINDING, Truth
from otolith.acquisition.window import Array

SECONDS, PERIOD = 2.0, 0.01
FLOOR = 1e-3  # of a signal's standard deviation: assumed noise of an ideal sensor


@dataclass(frozen=True, slots=True)
class Typical:
    """A component in words and numbers."""

    name: str
    truth: Truth | None
    """Nothing for a healthy motor."""
    kind: str = "steps"
    """Of operation."""


TYPICAL = (
    Typical("healthy", None),
    Typical("constant torque", Truth(SHAFT, "constant", "", 0.003)),
    Typical("torque, sine of time", Truth(SHAFT, "periodic", "t", 0.005855, 10.0, 0.4)),
    Typical("torque, sine of the angle", Truth(SHAFT, "periodic", "angle(omega)", 0.004, 1.0, 1.0)),
    Typical("Coulomb friction", Truth(SHAFT, "Coulomb", "omega", -0.004), "reversing"),
    Typical("quadratic drag", Truth(SHAFT, "power", "omega", -2e-5, 2.0)),
    Typical("torque, exponential in speed", Truth(SHAFT, "exponential", "omega", -0.0005, 0.15)),
    Typical("torque growing with time", Truth(SHAFT, "linear", "t", -0.003)),
    Typical("torque constant lower", Truth(SHAFT, "linear", "i", -0.004)),
    Typical("constant voltage", Truth(WINDING, "constant", "", -0.5)),
    Typical("voltage, sine of time", Truth(WINDING, "periodic", "t", 0.3, 20.0, -1.0)),
    Typical("voltage, share of V_a lost", Truth(WINDING, "linear", "V_a", -0.1)),
)


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """One window of a typical case."""

    measured: Array
    """(records, signals)."""
    noise: Array
    """(signals,) standard deviations."""
    x: Array
    """(records, sources) true values, in the order of :data:`SOURCES`."""

    def effect(self, truth: Truth) -> Array:
        """(records,) of a component, in the unit of its site."""
        place = SOURCES.index(truth.source) if truth.source else 0
        return np.array([truth.amplitude * truth.shape(float(value)) for value in self.x[:, place]])


def record(case: Typical, share: float, seed: int) -> Recorded:
    """With noise of that ``share`` of each signal's standard deviation, the inputs' among them."""
    faults = Faults() if case.truth is None else case.truth.faults()
    clean = simulate_motor(case.kind, SECONDS, faults, seed, noisy=False)
    random = np.random.default_rng([seed, 1])
    size = clean.std(axis=0)
    measured = clean + share * size * random.standard_normal(clean.shape)
    return Recorded(measured, max(share, FLOOR) * size, inputs_of(clean))


def inputs_of(signals: Array) -> Array:
    """(records, signals) -> (records, sources): time and angle before them."""
    t = PERIOD * np.arange(len(signals), dtype=np.float64)
    omega = signals[:, SIGNALS.index("omega")]
    angle = np.concatenate([[0.0], np.cumsum((omega[1:] + omega[:-1]) / 2.0) * PERIOD])
    return np.column_stack([t, angle, signals])


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of one method in one window."""

    right: bool
    """Site, family and input are true or equivalent; for a healthy motor, nothing is identified."""
    error: float
    """Relative error of its effect on the machine; not a number if it is not right."""
    spurious: int
    """Number of terms that do not exist."""


def error_of(estimated: Array, true: Array) -> float:
    """Relative error of an effect (records,), projected onto the true one."""
    return abs(float(estimated @ true) / float(true @ true) - 1.0)
