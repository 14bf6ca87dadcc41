"""Twins that are exported in the tests, along steps of their inputs, with the trajectories of the kernel."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.objective import input_matrix, time_offsets
from otolith.estimation.posterior import PhaseAdvance, Posterior
from otolith.estimation.problem import Component, Problem, WindowOptions, augment
from otolith.simulation.plan import planned_window
from otolith.simulation.simulate import STEP_RECORDS, substeps_of
from otolith.twin.kernel import Excitation, kernel_of
from otolith.twin.language import read_twin
from otolith_drivers.config_files import SourceFile
from tests.simulation.motors import PERIOD, posterior, problem

RECORDS = 60
FINE = 256  # times the substeps: the solution, although no step ends where a sign changes
COMPONENTS = (
    (Component("shaft", "periodic", "angle(omega)", 0.005, 1.0, 0.3, 0.5, 2.0),
     Component("winding", "linear", "omega", 0.02),
     Component("sensor of omega", "constant", "", 0.5)),
    (Component("shaft", "Coulomb", "omega", 0.004, 0.5, low=0.1, high=2.0),
     Component("sensor of T_load", "periodic", "t", 0.01, 6.0, 0.2, 1.0, 9.0),
     Component("gain of omega", "periodic", "angle(omega)", 0.02, 2.0, 0.1, 0.5, 4.0)),
    (Component("shaft", "exponential", "t", 1e-3, 0.2, low=0.01, high=1.0, origin=-3.0),
     Component("winding", "power", "i", 0.1, 1.5, low=0.3, high=4.0),
     Component("sensor of i", "negative exponential", "V_a", 0.1, 0.1, low=0.01, high=1.0)),
)  # fmt: skip
AWKWARD = """
[twin]
name = "awkward"
title = "names that mean something elsewhere"
source = "none"
validity = "none"

[states]
double = { unit = "m", meaning = "a type of C", bounds = [-5, 5] }
Real = { unit = "m/s", meaning = "a type of Modelica", bounds = [-5, 5] }

[inputs]
state = { unit = "N", hold = "zoh", range = [-1, 2], meaning = "what states are called in an FMU" }
end = { unit = "N", hold = "foh", range = [-1, 1], meaning = "a word of Modelica" }

[outputs]
double = { unit = "m", noise = 0.1, meaning = "a type of C" }

[parameters]
end_ = { unit = "kg", nominal = 2, bounds = [1, 3], role = "estimated", meaning = "near a word of Modelica" }
time = { unit = "N/m", nominal = 3, bounds = [1, 4], meaning = "a variable of FMI" }
indicator = { unit = "N*s/m", nominal = 0.4, bounds = [0, 4], meaning = "what switches are called" }
reading_of_double = { unit = "N", nominal = 0.2, bounds = [0, 4], meaning = "what outputs are called in Modelica" }
v = { unit = "N", nominal = 0.1, bounds = [0, 4], meaning = "the array of the generated C" }
M_PI = { unit = "1", nominal = 1, bounds = [0, 4], meaning = "a macro of C" }

[definitions]
elapsed = { expression = "M_PI*pi*v*sign(Real) + reading_of_double*tanh(Real/end__)", meaning = "an argument there" }

[constants]
end__ = { unit = "m/s", value = 0.1, meaning = "nearer to it" }

[equations]
"der(double)" = "Real"
"der(Real)" = "(state + end - time*double - indicator*Real - elapsed) / end_"

[sites]
force = { into = "der(Real)", mode = "additive", through = "1/end_", unit = "N", meaning = "force" }
"""


def completed(components: tuple[Component, ...]) -> Posterior:
    """The motor with components."""
    twin = augment(problem(), components)
    return replace(posterior().remap_parameters(twin), phase=PhaseAdvance(-1.99, PERIOD, (0.0,) * 3, (1.0, 10.0)))


def awkward_state() -> Posterior:
    """A twin whose names are words or names in one of the languages that it is exported to."""
    twin = read_twin(SourceFile(Path("awkward.toml"), AWKWARD))
    first, rest = twin.parameters[0], twin.parameters[1:]
    known, options = tuple((item.name, item.nominal) for item in rest), WindowOptions(200, 200, 200, PERIOD)
    own = Problem(twin, known, (first,), (0.1,), window=options)
    return replace(Posterior.initial(own), phase=PhaseAdvance(-1.99, PERIOD, (), (0.5, 0.2)))


@dataclass(frozen=True, eq=False)
class Driven:
    """A twin along a step of each input over its range."""

    state: Posterior

    @cached_property
    def times(self) -> Array:
        """(records,) s."""
        return PERIOD * np.arange(RECORDS, dtype=np.float64)

    @cached_property
    def columns(self) -> dict[str, Array]:
        """(records,) of each input."""
        is_low = np.arange(RECORDS) < STEP_RECORDS
        inputs = self.state.problem.base_model.inputs
        return {item.name: np.where(is_low, item.low, item.high) for item in inputs}

    @cached_property
    def substeps(self) -> int:
        """Of the integrator from record to record."""
        return substeps_of(self.state)

    @cached_property
    def exact(self) -> Array:
        """(records, outputs) of the kernel."""
        return self.simulated(self.substeps)

    @cached_property
    def solution(self) -> Array:
        """The same with so many substeps that the method of the integrator does not matter."""
        return self.simulated(FINE * self.substeps)

    def simulated(self, substeps: int) -> Array:
        """Return the outputs (records, outputs) of the kernel."""
        own = self.state.problem
        window = planned_window(own.base_model, self.times, self.columns, PERIOD, 0.0)
        known = dict(own.known) | time_offsets(own, 0.0)
        known |= dict(zip((item.name for item in own.free), self.state.at_last_record().prior().mean, strict=False))
        values = np.array([[known.get(item.name, item.nominal) for item in own.twin.parameters]])
        reached = np.zeros((1, len(own.twin.states)))
        assert self.state.phase is not None
        reached[0, : len(own.base_model.states)] = self.state.phase.last_state
        excitation = Excitation(input_matrix(own.twin, window), window.grid, substeps=substeps)
        outputs: Array = kernel_of(own.twin).simulate(values, reached, excitation)[0]
        return outputs
