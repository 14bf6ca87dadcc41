"""What a twin knows of the FMU that has its equations: frozen and picklable, as all of a definition."""

from dataclasses import dataclass, field

OF_STEPPED = 1e-4
"""Of a value or its typical size: step of a central difference of an FMU that is stepped. Theory: near the cube root of
the error of a solver, 1e-12 of a value."""


@dataclass(frozen=True, slots=True)
class FmuQuantity:
    """A real variable of an FMU that a twin uses."""

    name: str  # In the FMU
    reference: int
    scale: float  # Of its unit: the value in coherent units is ``scale`` times the FMU's own number
    size: float = 1.0  # Typical magnitude in its own unit; of a state, an input or a parameter
    start: float = 0.0  # Value at the start in its own unit


@dataclass(frozen=True, slots=True)
class FmuReference:
    """An FMU: ``rates`` and ``outputs`` as a function of ``states``, ``inputs`` and ``parameters``."""

    path: str = field(compare=False)  # Of the archive, absolute
    digest: str  # SHA-256 of the archive
    version: str  # Of FMI: "2" or "3"
    identifier: str  # Name of its binary
    token: str  # By which it recognises its own description
    states: tuple[FmuQuantity, ...]
    inputs: tuple[FmuQuantity, ...]
    parameters: tuple[FmuQuantity, ...]
    rates: tuple[FmuQuantity, ...]  # Of the states, in the same order
    outputs: tuple[FmuQuantity, ...] = ()  # Those that show no state
    integrals: tuple[
        tuple[int, int], ...
    ] = ()  # Rates that are states, by the numbers of both: the states integrate them
    has_slopes: bool = False  # Whether it offers directional derivatives
    is_model: bool = True  # For model exchange; otherwise for co-simulation, whose rates are those at its start
    is_stepped: bool = False
    """For co-simulation, without rates: those are the mean ones over a step, and ``rates`` are the states at its end.
    Then the references of ``states`` are those of the variables that set their start values."""
    can_restore: bool = False  # Whether its whole state can be read and set
    step: float = 0.0  # Of a trial, s, if it is stepped
    own_step: float = 0.0  # s: it makes steps of whole multiples of it; 0 if of any length

    @property
    def arguments(self) -> tuple[FmuQuantity, ...]:
        """What its rates and outputs depend on."""
        return (*self.states, *self.inputs, *self.parameters)

    @property
    def rows(self) -> tuple[FmuQuantity, ...]:
        """What it computes."""
        return (*self.rates, *self.outputs)
