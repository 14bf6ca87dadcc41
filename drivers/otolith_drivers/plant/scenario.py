"""What every scenario says, whatever the machine: seed, bus, sampling, and what happens to its parameters."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, model_validator

from otolith_drivers.can_bus import BusOptions
from otolith_drivers.errors import nearest
from otolith_drivers.plant.faults import Drift, Fault, Step, Unbalance
from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed

POSITIVE = 1e-12


class Scenario(Closed):
    """The part of a scenario file that all machines share."""

    UNITS: ClassVar[dict[str, str]]
    """Of each parameter that a fault may change."""
    HAS_SHAFT: ClassVar[bool] = False
    """Whether an unbalance means anything."""

    plant: str
    seed: int = 1
    integrator: Literal["accurate", "euler"] = "accurate"
    """``euler`` at 0.1 ms is the paper's plant; a real machine is continuous."""
    sample_period: Annotated[float, BeforeValidator(Quantity("s", 1e-3, 1.0))] = 0.01
    dbc: Path
    bus: BusOptions = BusOptions()
    parameters: Any
    faults: tuple[Fault, ...] = ()

    @model_validator(mode="after")
    def _faults_fit(self) -> Self:
        for fault in self.faults:
            if isinstance(fault, Unbalance):
                self._check_unbalance(fault)
            elif fault.parameter not in self.UNITS:
                known = nearest(fault.parameter, list(self.UNITS))
                raise ValueError(f"a fault names parameter {fault.parameter!r}: {known}")
            else:
                self.amount(fault)
        return self

    def _check_unbalance(self, fault: Unbalance) -> None:
        if not self.HAS_SHAFT:
            raise ValueError(f"plant {self.plant!r} has no shaft that could be out of balance")
        if (fault.frequency is None) == (fault.order is None):
            raise ValueError("an unbalance has either a frequency or an order of the shaft angle")

    def amount(self, fault: Drift | Step) -> float:
        """Of a fault, in the unit of its parameter."""
        return Quantity(self.UNITS[fault.parameter])(fault.amount)


class Ageing:
    """The parameters of a scenario as time goes by."""

    def __init__(self, scenario: Scenario) -> None:
        self._initial = dict(scenario.parameters)
        self._changes = [
            (fault, scenario.amount(fault)) for fault in scenario.faults if isinstance(fault, Drift | Step)
        ]

    def at(self, time: float) -> dict[str, float]:
        """Every parameter at ``time`` (s), in its unit."""
        values = dict(self._initial)
        for fault, amount in self._changes:
            values[fault.parameter] += fault.change(time, amount)
        return values
