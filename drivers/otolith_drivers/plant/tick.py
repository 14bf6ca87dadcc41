"""What a simulated machine says at each sampling instant."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tick:
    """One sampling instant."""

    time: float
    """s since the start of the scenario."""
    measured: dict[str, float]
    """Signals by their name on the bus, as sensors and drive see them."""
    truth: dict[str, float]
    """The parameters as they are, and the states without noise."""
