"""The paper's scenarios in which something appears that the twin does not know, one row each."""

from dataclasses import dataclass

from otolith.paper.rows import SENSORS, Sensor

NOISE = 0.005  # standard deviation of a sensor, as a share of that of its signal


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a component that is to be found."""

    name: str
    """In the report."""
    target: float | None = None
    """What its relative error shall stay below from the discovery on, with ideal sensors; None for no target."""
    noisy: float | None = None
    """The same with noisy sensors."""
    paper: float | None = None
    """The paper's relative error."""
    over: str = ""
    """The parameter by which the paper divides it, if it does."""
    unit: str = ""
    """The paper's, if it divides."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """A scenario in which a component appears."""

    name: str
    """Of the scenario file."""
    title: str
    machine: str
    """The machine file, for its twin, its known parameters and its noise."""
    parameter: str
    """The one that is estimated all the while; all others are known."""
    seconds: float
    component: str
    """The key that it has to be found as."""
    numbers: tuple[Number, ...]
    output: str
    """The one whose prediction the paper looks at."""
    within: float
    """What its largest error shall stay below from the discovery on, in its unit, with ideal sensors."""
    paper: tuple[float, float] | None
    """The paper's largest errors before and after the discovery; None for what it does not say."""
    figures: tuple[str, str]
    """The paper's numbers for the outputs before and after."""
    sensors: tuple[Sensor, ...] = ()
    """Noisy ones; none for noise in proportion to the signals (:data:`NOISE`)."""


UNKNOWNS = (
    Unknown(
        name="unbalance",
        title="unbalanced shaft",
        machine="dc-motor",
        parameter="R_a",
        seconds=120.0,
        component="shaft/periodic/t",
        numbers=(
            Number("amplitude", target=2e-4, paper=0.016, over="J", unit="rad/s^2"),
            Number("frequency", target=2e-5, paper=0.0022),
            Number("phase"),
        ),
        output="omega",
        within=5e-4,
        paper=(0.5, 0.02),
        figures=("12", "13"),
        sensors=SENSORS["dc-motor"],
    ),
    Unknown(
        name="hydraulic-leak",
        title="internal leak",
        machine="hydraulic-actuator",
        parameter="D",
        seconds=600.0,
        component="pressure/constant",
        numbers=(Number("amplitude", target=1e-6, noisy=0.01, paper=4.5e-7),),
        output="p",
        within=0.2,
        paper=None,
        figures=("19-20", "21-22"),
    ),
)

UNKNOWN_NAMES = tuple(row.name for row in UNKNOWNS)


def unknown_of(name: str) -> Unknown:
    """The row of that name."""
    return next(row for row in UNKNOWNS if row.name == name)
