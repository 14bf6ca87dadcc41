"""A simulation as one HTML page that refers to no other file: a plot of each output with its band, and of each input.

The page is ``simulation.html``, a template that escapes what it inserts.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from otolith import __version__
from otolith.acquisition.window import Array
from otolith.health.text import Texts
from otolith.simulation.prediction import Prediction
from otolith.twin.definition import Definition
from otolith.twin.kernel import Indices
from otolith_drivers.outside_text import visible
from otolith_drivers.units import equation_text, formula_text, quantity_text

# Engineering choice, see docs/reference/thresholds-runtime.md.
MAX_COLUMNS = 600  # of a plot, each with the lowest and highest value of its records


@dataclass(frozen=True, slots=True)
class SimulationRow:
    """A parameter in the table of the page."""

    name: str
    meaning: str
    text: str  # Value with interval and unit


@dataclass(frozen=True, slots=True)
class SimulationCurve:
    """The plot of an output; of an input without band and measured values. Points are as SVG takes them."""

    name: str
    meaning: str
    unit: str
    line: str
    top: str  # Value at the upper edge
    bottom: str
    band: str = ""
    measured: tuple[str, ...] = ()  # A line for each stretch without a gap
    end: str = ""  # The value at the end, with its interval
    agreement: tuple[str, str] | None = None  # RMSE, and share of the measured values within the band


@dataclass(frozen=True, slots=True)
class SimulatedMachine:
    """What the page says of the machine."""

    name: str
    site: str
    twin: Definition
    notes: Sequence[str]  # Of which state the simulation is, and what is supposed, a line each
    parameters: Sequence[SimulationRow]
    components: Mapping[str, str]  # Equations by key


def simulation_page(prediction: Prediction, machine: SimulatedMachine, texts: Texts) -> str:
    """Return the page."""
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: _shown(value, texts),
    )
    environment.filters |= {"words": texts.translated, "equation_text": equation_text, "formula_text": formula_text}
    template = environment.from_string((files(__package__) / "simulation.html").read_text(encoding="utf-8"))
    twin = machine.twin
    return template.render(
        say=texts, machine=machine.name, site=machine.site, title=twin.title, notes=machine.notes, version=__version__,
        diverges=None if prediction.diverges is None else prediction.start + prediction.diverges,
        curves=[*_outputs(prediction, twin), *_inputs(prediction, twin)], parameters=machine.parameters,
        components=machine.components,
        begin=f"{prediction.times[0]:.10g}", end=f"{prediction.times[-1]:.10g}", draws=prediction.draws,
        seed=prediction.seed,
    )  # fmt: skip


def _shown(value: object, texts: Texts) -> object:
    """Return what the template inserts with its controls escaped; the engine escapes the signs of HTML."""
    is_text = isinstance(value, str) and not isinstance(value, Markup)
    return visible(texts.decimals(str(value))) if is_text else value


def _outputs(prediction: Prediction, twin: Definition) -> Iterator[SimulationCurve]:
    """Yield the plot of each output."""
    for column, output in enumerate(twin.outputs):
        value, low, high = (part[:, column] for part in (prediction.values, prediction.low, prediction.high))
        measured = prediction.measured[:, column]
        plot = _Plot.around(prediction.offsets, low, high, measured)
        rmse, share = prediction.rmse(output.name), prediction.coverage(output.name)
        agreement = None
        if rmse is not None and share is not None:
            agreement = quantity_text(rmse, output.unit, digits=3), f"{share:.1%}"
        end = quantity_text(float(value[-1]), output.unit, 0.5 * float(high[-1] - low[-1]))
        yield SimulationCurve(
            output.name, output.meaning, output.unit, plot.line(value), *plot.ends(output.unit),
            plot.band(low, high), tuple(plot.lines(measured)), end, agreement,
        )  # fmt: skip


def _inputs(prediction: Prediction, twin: Definition) -> Iterator[SimulationCurve]:
    """Yield the plot of each input."""
    for column, driven in enumerate(twin.inputs):
        value = prediction.driving[:, column]
        plot = _Plot.around(prediction.offsets, value)
        yield SimulationCurve(driven.name, driven.meaning, driven.unit, plot.line(value), *plot.ends(driven.unit))


@dataclass(frozen=True, slots=True, eq=False)
class _Plot:
    """Positions in a plot, in percent from its left and from its top."""

    x: Array  # (columns,)
    begins: Indices  # (columns,) number of the first record of each column
    low: float
    high: float

    @classmethod
    def around(cls, offsets: Array, *curves: Array) -> "_Plot":
        """Return a plot that shows all ``curves`` (records,)."""
        columns = min(MAX_COLUMNS, len(offsets))
        begins = np.unique(np.linspace(0, len(offsets) - 1, columns).astype(np.int64))
        values = np.concatenate([curve[np.isfinite(curve)] for curve in curves])
        low, high = float(values.min()), float(values.max())
        margin = 0.04 * (high - low) or 0.5 * max(abs(high), 1e-9)
        x = 100.0 * offsets[begins] / (float(offsets[-1]) or 1.0)
        return cls(x, begins, low - margin, high + margin)

    def ends(self, unit: str) -> tuple[str, str]:
        """Return the values at the upper and at the lower edge."""
        return quantity_text(self.high, unit, digits=4), quantity_text(self.low, unit, digits=4)

    def line(self, curve: Array) -> str:
        """Return a curve without gaps: in each column the lowest and the highest value."""
        lowest, highest = np.minimum.reduceat(curve, self.begins), np.maximum.reduceat(curve, self.begins)
        rises = np.append(np.diff(curve[self.begins]) >= 0.0, True)
        ends = np.stack([np.where(rises, lowest, highest), np.where(rises, highest, lowest)], axis=1)
        return self._points(np.repeat(self.x, 2), ends.ravel())

    def lines(self, curve: Array) -> Iterator[str]:
        """Yield the parts of a curve between gaps, which are not-a-number: the highest value in each column."""
        known = np.fmax.reduceat(curve, self.begins)
        present = np.flatnonzero(np.isfinite(known))
        if len(present):
            for part in np.split(present, np.flatnonzero(np.diff(present) > 1) + 1):
                yield self._points(self.x[part], known[part])

    def band(self, low: Array, high: Array) -> str:
        """Return the polygon between two curves."""
        lowest, highest = np.minimum.reduceat(low, self.begins), np.maximum.reduceat(high, self.begins)
        return self._points(np.append(self.x, self.x[::-1]), np.append(highest, lowest[::-1]))

    def _points(self, x: Array, values: Array) -> Markup:
        """Return points; they are no text of a language, whose decimal sign may be another."""
        y = 100.0 * (self.high - values) / (self.high - self.low)
        pairs = zip(x.tolist(), y.tolist(), strict=True)
        return Markup(" ").join(Markup("{},{}").format(f"{across:.2f}", f"{down:.2f}") for across, down in pairs)
