"""A DC motor whose winding resistance is known to an interval, plans for it, and the twins of the library."""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.posterior import PhaseAdvance, Posterior
from otolith.estimation.problem import Problem, WindowOptions
from otolith.machine import find_twin
from otolith.simulation.plan import planned_window

PERIOD = 0.01
TWIN = find_twin("dc_motor")
NOISE = {"i": 0.005, "omega": 0.02}


def problem() -> Problem:
    """The resistance is estimated, all else is known."""
    free = tuple(item for item in TWIN.parameters if item.name == "R_a")
    known = tuple((item.name, item.nominal) for item in TWIN.parameters if item.name != "R_a")
    options = WindowOptions(200, 200, 200, PERIOD)
    return Problem(TWIN, known, free, tuple(NOISE.values()), input_noise=(0.0, 2e-4), window=options)


def posterior(
    sd: float = 0.02, trend: float = 0.0, state: tuple[float, float] = (1.0, 10.0), own: Problem | None = None
) -> Posterior:
    """The resistance is 6.5 ohm ± ``sd`` and moves by ``trend`` (ohm/s); the last record showed ``state``."""
    own = own or problem()
    belief = Posterior.initial(own).reset_value(0, 6.5, sd).reset_value(1, trend, 0.0).belief
    calm = replace(belief, level=np.zeros_like(belief.level))
    return Posterior(own, calm, PhaseAdvance(-1.99, PERIOD, (), state))


def plan(seconds: float, voltage: float = 20.0) -> Window:
    """The voltage is constant, and so is the load."""
    times = np.array([0.0, seconds])
    columns: dict[str, Array] = {"V_a": np.full(2, voltage), "T_load": np.full(2, 0.02)}
    return planned_window(TWIN, times, columns, PERIOD, 0.0)


def library_state(name: str) -> Posterior:
    """A twin of the library with the values of its file."""
    twin = find_twin(name)
    first, rest = twin.parameters[0], twin.parameters[1:]
    noise = tuple(output.noise for output in twin.outputs)
    known, options = tuple((item.name, item.nominal) for item in rest), WindowOptions(200, 200, 200, PERIOD)
    own = Problem(twin, known, (first,), noise, window=options)
    reached = tuple(state.initial for state in twin.states)
    return replace(Posterior.initial(own), phase=PhaseAdvance(-1.99, PERIOD, (), reached))
