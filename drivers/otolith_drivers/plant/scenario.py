"""A scenario: which machine is simulated, how it is driven, how it is measured, and what happens to it."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.can_bus import BusOptions
from otolith_drivers.errors import nearest
from otolith_drivers.plant.faults import Drift, Fault, Seconds, Step, Unbalance
from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed, load

Positive = 1e-12

# Table 3 of the paper.
PARAMETERS: dict[str, tuple[str, float]] = {
    "R_a": ("ohm", 6.5),
    "L_a": ("H", 0.673),
    "J": ("kg*m^2", 0.001171),
    "K_e": ("V*s/rad", 0.038),
    "K_t": ("N*m/A", 0.038),
    "D": ("N*m*s/rad", 0.00143),
}


class Parameters(Closed):
    """The motor's parameters at time zero; the default values are Table 3 of the paper."""

    R_a: Annotated[float, BeforeValidator(Quantity("ohm", Positive))] = PARAMETERS["R_a"][1]
    L_a: Annotated[float, BeforeValidator(Quantity("H", Positive))] = PARAMETERS["L_a"][1]
    J: Annotated[float, BeforeValidator(Quantity("kg*m^2", Positive))] = PARAMETERS["J"][1]
    K_e: Annotated[float, BeforeValidator(Quantity("V*s/rad", Positive))] = PARAMETERS["K_e"][1]
    K_t: Annotated[float, BeforeValidator(Quantity("N*m/A", Positive))] = PARAMETERS["K_t"][1]
    D: Annotated[float, BeforeValidator(Quantity("N*m*s/rad", 0.0))] = PARAMETERS["D"][1]


class Controller(Closed):
    """The drive's speed controller, a PI with the gains of the paper."""

    K_p: Annotated[float, BeforeValidator(Quantity("V*s/rad", 0.0))] = 0.3
    K_i: Annotated[float, BeforeValidator(Quantity("V/rad", 0.0))] = 0.1
    voltage_limit: Annotated[float, BeforeValidator(Quantity("V", Positive))] = 48.0


class SetPoint(Closed):
    """The speed asked for, from a moment on."""

    at: Seconds
    speed: Annotated[float, BeforeValidator(Quantity("rad/s", -1e4, 1e4))]


class Noise(Closed):
    """Standard deviation of each sensor; what the controller sees is as noisy as what the bus carries."""

    current: Annotated[float, BeforeValidator(Quantity("A", 0.0))] = 0.0
    speed: Annotated[float, BeforeValidator(Quantity("rad/s", 0.0))] = 0.0
    load_torque: Annotated[float, BeforeValidator(Quantity("N*m", 0.0))] = 0.0


class Scenario(Closed):
    """The whole file."""

    plant: Literal["dc_motor"]
    seed: int = 1
    integrator: Literal["accurate", "euler"] = "accurate"
    """``euler`` at 0.1 ms is the paper's plant (Eq. 11-12); a real machine is continuous."""
    sample_period: Annotated[float, BeforeValidator(Quantity("s", 1e-3, 1.0))] = 0.01
    dbc: Path
    bus: BusOptions = BusOptions()
    parameters: Parameters = Parameters()
    load: Annotated[float, BeforeValidator(Quantity("N*m*s/rad", 0.0))] = 0.006
    """Load torque per speed."""
    controller: Controller = Controller()
    set_points: Annotated[tuple[SetPoint, ...], Field(min_length=1)]
    repeat_every: Seconds | None = None
    """The set-points start again after this time; without it the last one stays."""
    noise: Noise = Noise()
    faults: tuple[Fault, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        moments = [point.at for point in self.set_points]
        if moments != sorted(set(moments)):
            raise ValueError("set_points must be in the order of their times, each time once")
        if self.repeat_every is not None and moments[-1] >= self.repeat_every:
            raise ValueError(f"repeat_every ({self.repeat_every:g} s) must be later than the last set-point")
        for fault in self.faults:
            _check(fault)
        return self


def _check(fault: Drift | Step | Unbalance) -> None:
    if isinstance(fault, Unbalance):
        if (fault.frequency is None) == (fault.order is None):
            raise ValueError("an unbalance has either a frequency or an order of the shaft angle")
    elif fault.parameter not in PARAMETERS:
        raise ValueError(f"a fault names parameter {fault.parameter!r}: {nearest(fault.parameter, list(PARAMETERS))}")
    else:
        Quantity(PARAMETERS[fault.parameter][0])(fault.amount)


def load_scenario(path: Path) -> Scenario:
    """The scenario in ``path``, its DBC made relative to the file.

    Raises:
        ConfigurationError: see :func:`otolith_drivers.toml_files.load`.
    """
    scenario = load(path, Scenario)
    return scenario.model_copy(update={"dbc": path.parent / scenario.dbc})
