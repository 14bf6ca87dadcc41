"""True components: the formulas are repeated here, so that an error in those of the twin shows."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.discovery.motor import Faults, Term

SHAFT, WINDING = "shaft", "winding"
SOURCES = ("t", "angle(omega)", "V_a", "T_load", "i", "omega")  # in the order of a term's arguments

Shape = Callable[[float, float, float], float]  # of the input, the inner number and the phase


def _sign(x: float) -> float:
    return math.copysign(1.0, x) if x else 0.0


SHAPES: dict[str, Shape] = {
    "constant": lambda x, b, c: 1.0,
    "linear": lambda x, b, c: x,
    "exponential": lambda x, b, c: math.exp(b * x),
    "negative exponential": lambda x, b, c: math.exp(-b * x),
    "power": lambda x, b, c: _sign(x) * abs(x) ** b,
    "logarithmic": lambda x, b, c: math.log(max(abs(x), 1e-9)),
    "periodic": lambda x, b, c: math.sin(b * x + c),
    "Coulomb": lambda x, b, c: _sign(x),
    "Stribeck": lambda x, b, c: _sign(x) * math.exp(-((x / b) ** 2)),
}


@dataclass(frozen=True, slots=True)
class Truth:
    """A component with its numbers."""

    site: str
    family: str
    source: str
    """Empty for nothing."""
    amplitude: float
    """N·m on the shaft, V in the winding."""
    inner: float = 0.0
    phase: float = 0.0
    """rad."""

    @property
    def key(self) -> str:
        """As :attr:`otolith.estimation.problem.Component.key`."""
        return f"{self.site}/{self.family}" + (f"/{self.source}" if self.source else "")

    def shape(self, x: float) -> float:
        """For an amplitude of one."""
        return SHAPES[self.family](x, self.inner, self.phase)

    def faults(self) -> Faults:
        """For one simulation: the term keeps the angle of its first record."""
        term = self._term()
        return Faults(torque=term) if self.site == SHAFT else Faults(voltage=term)

    def _term(self) -> Term:
        place = SOURCES.index(self.source) if self.source else 0
        first_angle: list[float] = []  # at the first record, where the twin's angle is zero

        def term(*x: float) -> float:
            if not first_angle:
                first_angle.append(x[1])
            return self.amplitude * self.shape(x[place] - first_angle[0] if place == 1 else x[place])

        return term


def same(truth: Truth) -> frozenset[str]:
    """The keys of all components that are equivalent to the truth in this motor, and its own.

    The load torque is 0.006 N·m·s/rad times the speed, so what depends on one depends on the other, but for a
    logarithm, whose constant tells them apart. A sensor of an input that has an offset or is off in its gain does to
    the twin what a constant or a gain of this input at its site does.
    """
    keys = {truth.key}
    other = {"T_load": "omega", "omega": "T_load"}.get(truth.source)
    if other is not None and truth.family != "logarithmic":
        keys.add(f"{truth.site}/{truth.family}/{other}")
    signal = "T_load" if truth.site == SHAFT else "V_a"
    if truth.family == "constant":
        keys.add(f"sensor of {signal}/constant")
    if truth.family == "linear" and (truth.site, truth.source) == (WINDING, "V_a"):
        keys.add("sensor of V_a/linear/V_a")
    return frozenset(keys)


def is_a_parameter(site: str, family: str, source: str) -> bool:
    """Whether it is equivalent to a free parameter: D by the speed or the load torque, R_a by the current."""
    moved = {(SHAFT, "omega"), (SHAFT, "T_load"), (WINDING, "i")}
    return family == "linear" and (site, source) in moved
