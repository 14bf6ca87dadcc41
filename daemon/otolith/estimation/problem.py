"""The estimation problem of a machine: twin, known and free parameters, noise levels, components. Plain: it pickles.

The twin is augmented: it has components in its slots (Eq. 3 of the paper).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from otolith.acquisition.samples import Check
from otolith.acquisition.window import Array, Mask, Window, runs_of
from otolith.estimation.sensor_models import SensorModel
from otolith.twin.components import (
    MAX_COMPONENTS,
    ComponentFamily,
    ComponentSource,
    augmented_model,
    component_parameters,
    family_code,
    family_of,
    family_setting,
    site_setting,
    sites,
    source_setting,
    sources,
)
from otolith.twin.definition import Definition, OperatingRange, Parameter, Site

UNLIMITED = 1e30  # bound of an amplitude that nothing limits; any finite number would do
MIN_SCALE = 0.01  # share of the width of the bounds: the size of a parameter whose nominal value is about zero
MAX_CHANGE = 1.5  # ratio of two consecutive window lengths
MIN_CHANGE = 1.2  # ratio below which the window length stays as it is
SHORTENED = 0.5  # ratio of window lengths after a window that the twin does not explain
AMPLITUDE_BOUND = 10.0  # times the discovered amplitude
INNER_BOUND = 3.0  # times the discovered inner parameter, up and down
MIN_RUN = 5  # readings of a signal in a row that are no wrong ones: outside of a range, of one value, without a command
PHASE_BOUND = 4.0 * np.pi  # rad; every window brings the phase back between -pi and pi


@dataclass(frozen=True, slots=True)
class Component:
    """A component that the twin lacks: site, family, source, and its values when it was discovered."""

    site: str
    family: str
    source: str  # Empty for none, t, angle(omega), or the name of a signal or state
    amplitude: float  # In the unit of the site
    inner: float = 0.0  # The family's nonlinear parameter: a frequency, an order, a rate or an exponent
    phase: float = 0.0  # rad, at the first record of the window of discovery
    low: float = 0.0  # Lower bound of the inner parameter
    high: float = 0.0  # Upper bound of the inner parameter
    amplitude_low: float = -UNLIMITED  # Lower bound of the amplitude, in the unit of the site
    amplitude_high: float = UNLIMITED  # Upper bound of the amplitude
    origin: float = 0.0  # Service time in s at which a source t that is not periodic counts zero

    @property
    def key(self) -> str:
        """Identifies the component within the machine."""
        return key_of(self.site, self.family, self.source)

    @property
    def model(self) -> ComponentFamily:
        """The family."""
        return family_of(self.family)

    @property
    def periodic(self) -> bool:
        """Whether the component has a phase."""
        return len(self.model.phases) > 1


def key_of(site: str, family: str, source: str) -> str:
    """Return ``site/family/source``, without the source if there is none."""
    return f"{site}/{family}/{source}".rstrip("/")


AlgorithmName = Literal["pso", "de", "cmaes", "ga"]


@dataclass(frozen=True, slots=True)
class SwarmOptions:
    """Settings of the global search (Table 2 of the paper)."""

    algorithm: AlgorithmName = "pso"
    size: int = 15
    generations: int = 1000
    inertia: float = 0.9
    cognitive: float = 2.0
    social: float = 2.0


@dataclass(frozen=True, slots=True)
class WindowOptions:
    """Records per window."""

    records: int = 200  # Of the first window, and of all windows if the length is fixed
    shortest: int = 200
    longest: int = 200
    sample_period: float | None = None  # Nominal time between two records, s; None for that of each window


@dataclass(frozen=True, slots=True)
class Problem:
    """What is estimated, from what, under which noise."""

    twin: Definition
    known: tuple[tuple[str, float], ...]  # Name and value of each parameter that is given
    free: tuple[Parameter, ...]  # Parameters to estimate, with the nominal values and bounds of this machine
    noise: tuple[float, ...]  # Standard deviation of the sensor of each output
    stated_noise: tuple[float, ...] = ()
    """:attr:`levels` as the machine file states them, where windows have shown others; empty otherwise."""
    steps: tuple[float, ...] = ()
    """Step of the converter of each output, as the windows have shown it; 0 or empty for none."""
    input_noise: tuple[float, ...] = ()  # Standard deviation of each input; empty for none
    process_noise: tuple[float, ...] = ()
    """Standard deviation of each state per square root of a second; empty for none."""
    open_loop: bool = False  # Use the paper's cost: no innovation corrects the twin within a window
    determined_within: float = 0.1
    """A parameter is determined when half of its 95 % interval is at most this share of its value."""
    components: tuple[Component, ...] = ()
    """Components in the twin. Their values are free parameters with names that begin with an underscore."""
    unchecked: frozenset[tuple[str, Check]] = frozenset()
    """Checks of the data that are turned off, each with its signal."""
    sensors: tuple[tuple[str, SensorModel], ...] = ()  # Of the signals whose reading may stay
    delays: tuple[tuple[str, float], ...] = ()
    """Signals that are late in the windows, and by how many seconds: their samples are moved before a fit."""
    changing: tuple[str, ...] = ()  # Commands that change between their samples, as windows have shown it
    excluded: frozenset[str] = frozenset()  # Keys of components that discovery leaves out
    discover: bool = True  # Whether discovery looks for components of the machine
    window: WindowOptions = WindowOptions()
    swarm: SwarmOptions = SwarmOptions()
    seed: int = 1

    base_model: Definition = field(init=False, compare=False, repr=False)  # The twin without slots for components
    scale: Array = field(init=False, compare=False, repr=False)
    """(free,) the size of each parameter, to which accuracy is relative."""
    nominal: Array = field(init=False, compare=False, repr=False)  # (free,) values of the machine file
    bounds: tuple[Array, Array] = field(init=False, compare=False, repr=False)  # (free,) lower and upper bounds

    def __post_init__(self) -> None:
        low, high = (np.array([getattr(free, end) for free in self.free]) for end in ("low", "high"))
        nominal = np.array([free.nominal for free in self.free])
        derived = {
            "base_model": self.twin.base or self.twin,
            "scale": np.maximum(np.abs(nominal), MIN_SCALE * (high - low)),
            "nominal": nominal,
            "bounds": (low, high),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @property
    def levels(self) -> tuple[float, ...]:
        """Noise of each input, then of each output, in the order of the twin's signals; then process noise."""
        twin = self.base_model
        inputs, states = self.input_noise or (0.0,) * len(twin.inputs), self.process_noise or (0.0,) * len(twin.states)
        return (*inputs, *self.noise, *states)

    def sensor(self, name: str) -> SensorModel:
        """Return how the reading of a signal follows what it measures, as far as the machine file states it."""
        return dict(self.sensors).get(name, SensorModel())

    @property
    def stated_levels(self) -> tuple[float, ...]:
        """:attr:`levels` as the machine file states them."""
        return self.stated_noise or self.levels

    def with_levels(self, levels: Sequence[float]) -> "Problem":
        """Return the problem with other :attr:`levels`."""
        inputs, outputs = len(self.base_model.inputs), len(self.noise)
        before, own, after = levels[:inputs], levels[inputs : inputs + outputs], levels[inputs + outputs :]
        return replace(
            self,
            noise=tuple(own),
            input_noise=tuple(before) if self.input_noise or any(before) else (),
            process_noise=tuple(after) if self.process_noise or any(after) else (),
            stated_noise=() if tuple(levels) == self.stated_levels else self.stated_levels,
        )


@dataclass(frozen=True, slots=True, eq=False)
class WindowExcitation:
    """What a window showed of the parameters."""

    sd: Array  # (free,) standard deviation of each parameter from the window alone; infinite for none
    trend: Array  # (free,) root mean square of each parameter's trend, per second
    explained: bool  # Whether the twin leaves nothing but noise


def next_records(options: WindowOptions, length: float, sample_period: float, excitation: WindowExcitation) -> int:
    """Return the records of the window after one of ``length`` (s) that showed ``excitation``.

    The paper leaves this open (section 6). The estimate from a window alone is about its middle: against the value at
    its end it is off by trend · length / 2, and its variance falls with its length. The sum of squared bias and
    variance is least where length³ = 2 · variance · length now / trend².
    Records are nominal ones, ``sample_period`` s apart, however many samples come.
    """
    sd, trend, explained = excitation.sd, excitation.trend, excitation.explained
    determined = np.isfinite(sd) & (trend > 0.0)
    if not explained:
        wanted = SHORTENED * length
    elif not determined.any():
        wanted = MAX_CHANGE * length
    else:
        wanted = float(np.cbrt(2.0 * sd[determined] ** 2 * length / trend[determined] ** 2).min())
    wanted = float(np.clip(wanted, length / MAX_CHANGE if explained else SHORTENED * length, MAX_CHANGE * length))
    if 1.0 / MIN_CHANGE < wanted / length < MIN_CHANGE:
        return int(np.clip(round(length / sample_period), options.shortest, options.longest))
    return int(np.clip(round(wanted / sample_period), options.shortest, options.longest))


def site_of(twin: Definition, name: str) -> Site:
    """Return the site of that name; ``twin`` is the base model."""
    return next(site for site in sites(twin) if site.name == name)


def source_of(twin: Definition, name: str) -> ComponentSource:
    """Return the source of that name; ``twin`` is the base model."""
    return next(source for source in sources(twin) if source.name == name)


def augment(problem: Problem, components: Sequence[Component]) -> Problem:
    """Return the problem with ``components`` added to those in its twin; their values are free parameters.

    Raises:
        ValueError: more components than the twin has slots.
    """
    twin, together = problem.base_model, (*problem.components, *components)
    if len(together) > MAX_COMPONENTS:
        raise ValueError(f"{len(together)} components: a twin has {MAX_COMPONENTS} slots")
    free = [parameter for parameter in problem.free if not parameter.name.startswith("_")]
    kept = {parameter.name: parameter for parameter in problem.free if parameter.name.startswith("_")}
    known = [pair for pair in problem.known if not pair[0].startswith("_")]
    for slot, component in enumerate(together):
        known += _settings(twin, slot, component).items()
        free += [kept.get(parameter.name, parameter) for parameter in _free_values(twin, slot, component)]
    return replace(problem, twin=augmented_model(twin), free=tuple(free), known=tuple(known), components=together)


def without(problem: Problem, removed: Component) -> Problem:
    """Return the problem without one of its components."""
    rest = [component for component in problem.components if component is not removed]
    bare = replace(
        problem,
        twin=problem.base_model,
        components=(),
        free=tuple(parameter for parameter in problem.free if not parameter.name.startswith("_")),
        known=tuple(pair for pair in problem.known if not pair[0].startswith("_")),
    )
    return augment(bare, rest) if rest else bare


def _settings(twin: Definition, slot: int, component: Component) -> dict[str, float]:
    """Return the known parameters that select family, site and source of a slot."""
    at = [site.name for site in sites(twin)].index(component.site)
    settings = {family_setting(slot): family_code(component.family), site_setting(slot, at): 1.0}
    source = [source.name for source in sources(twin)].index(component.source)
    return settings | ({source_setting(slot, source): 1.0} if source else {})


def _free_values(twin: Definition, slot: int, component: Component) -> list[Parameter]:
    """Return amplitude, inner parameter and phase as free parameters, as far as the family has them."""
    amplitude, inner, phase = component_parameters(slot)
    unit, model = site_of(twin, component.site).unit, component.model
    reach = AMPLITUDE_BOUND * abs(component.amplitude)
    low = max(0.0 if component.periodic else -reach, component.amplitude_low)
    high = min(reach, component.amplitude_high)
    values = [Parameter(amplitude, unit, component.amplitude, low, high, f"amplitude of {component.key}")]
    if model.inner is not None:
        unit = model.inner.unit.format(x=source_of(twin, component.source).unit)
        bounds = max(component.low, component.inner / INNER_BOUND), min(component.high, component.inner * INNER_BOUND)
        values.append(Parameter(inner, unit, component.inner, *bounds, f"{model.inner.meaning} of {component.key}"))
    if component.periodic:
        meaning = f"phase of {component.key}"
        values.append(Parameter(phase, "rad", component.phase, -PHASE_BOUND, PHASE_BOUND, meaning))
    return values


def indices(problem: Problem, slot: int) -> list[int]:
    """Return where the values of a slot stand among the free parameters: amplitude, inner parameter, phase."""
    names = [parameter.name for parameter in problem.free]
    return [names.index(name) for name in component_parameters(slot) if name in names]


def amplitude_indices(problem: Problem) -> list[int]:
    """Return where the amplitudes of all components stand among the free parameters."""
    return [indices(problem, slot)[0] for slot in range(len(problem.components))]


def slot_of(problem: Problem, component: Component) -> int | None:
    """Return the slot of a component, or None if the twin does not have it."""
    keys = [other.key for other in problem.components]
    return keys.index(component.key) if component.key in keys else None


def wrapped(phase: float) -> float:
    """Return a phase in (−π, π]: the filter lets it grow beyond."""
    return math.pi - (math.pi - phase) % math.tau if math.isfinite(phase) else phase


def equation(twin: Definition, component: Component, values: Sequence[float]) -> str:
    """Return the component as text; ``values`` are amplitude, inner parameter and phase as far as it has them."""
    rest = [*values[1:], 0.0, 0.0]
    angle = wrapped(rest[1]) if component.periodic else rest[1]
    phase = f"{'-' if angle < 0.0 else '+'} {abs(angle):.2f}"
    text = component.model.equation.format(a=f"{values[0]:.4g}", b=f"{rest[0]:.4g}", c=phase, x=component.source)
    text = text.replace("--", "")  # exp(--0.1·x) is exp(0.1·x)
    site = site_of(twin, component.site)
    text = f"{text}·{site.into}" if site.through == site.into else text  # in proportion to what a sensor shows
    return text if site.unit == "1" else f"{text} {site.unit}"


def runs_outside(own: OperatingRange, window: Window) -> list[tuple[int, int, float]]:
    """Return first record, end and first reading of each stretch of a window in which a signal is outside of a range.

    It stays where it was until it is measured again. Fewer readings in a row are wrong ones, unless the window has no
    others.
    """
    measured = np.flatnonzero(~window.missing_in(own.signal))
    readings = window.readings(own.signal)[measured]
    edges = np.concatenate([[0], measured[1:], [window.records]])
    least = min(MIN_RUN, len(measured))
    runs = runs_of((readings < own.low) | (readings > own.high))
    return [
        (int(edges[first]), int(edges[last]), float(readings[first])) for first, last in runs if last - first >= least
    ]


def out_of_operation(twin: Definition, window: Window) -> Mask:
    """Return where the equations of a twin need not hold (records,), as it states."""
    outside = np.zeros(window.records, dtype=np.bool_)
    for own in twin.operation:
        for first, last, _ in runs_outside(own, window):
            outside[first:last] = True
    return outside
