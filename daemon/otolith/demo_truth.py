"""What was injected into the simulated machine of the demonstration, against what was found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Verdict
from otolith.adaptation.information import QUANTILE
from otolith.health.finding import ComponentDocument
from otolith.health.report import ReportDocument, Status
from otolith_drivers.plant.faults import Unbalance

BEGINNING = 2  # windows that need not have found anything yet
CURRENT_FLOWS = 0.1  # A, mean over the window
INNER, AMPLITUDE = 0.01, 0.05  # of what was injected: what order or frequency, and amplitude, must be found within


@dataclass(frozen=True, slots=True)
class Comparison:
    """One parameter in one window: injected (at its end, as reports speak of it) against found."""

    window: int
    end: float
    parameter: str
    injected: float
    found: float | None
    half_width: float | None
    """Of the 95 % interval."""

    @property
    def error(self) -> float:
        """Relative; infinite where nothing was found."""
        return float("inf") if self.found is None else abs(self.found / self.injected - 1.0)


def compare(reports: Sequence[ReportDocument], truth: Mapping[str, Sequence[float]]) -> list[Comparison]:
    """Every parameter of every good window with current flowing; ``truth`` is columns over Unix time ``t`` (s)."""
    times = np.asarray(truth["t"])
    compared = []
    for report in reports:
        inside = (times >= report.window.start) & (times <= report.window.end)
        if report.window.quality.verdict is not Verdict.GOOD or not inside.any():
            continue
        if "i" in truth and np.abs(np.asarray(truth["i"])[inside]).mean() < CURRENT_FLOWS:
            continue
        for name, parameter in report.parameters.items():
            if name not in truth:  # the simulated machine has no such parameter
                continue
            if report.window.index < BEGINNING and parameter.status is Status.UNESTIMATED:
                continue  # the machine may have begun to move as the window ended
            found = parameter.value if parameter.status in (Status.ESTIMATED, Status.HELD) else None
            half = None if found is None or parameter.sd is None else QUANTILE * parameter.sd
            injected = float(np.asarray(truth[name])[inside][-1])
            compared.append(Comparison(report.window.index, report.window.end, name, injected, found, half))
    return compared


@dataclass(frozen=True, slots=True)
class Shaking:
    """An unbalance of the scenario, and the component that was found of it."""

    source: str
    inner: float
    """Order, or frequency in rad/s."""
    amplitude: float
    """N·m."""
    found: ComponentDocument | None

    @property
    def right(self) -> bool:
        """Whether it was found for what it is."""
        if self.found is None:
            return False
        amplitude, inner = list(self.found.values.values())[:2]
        close = (
            abs(inner.value / self.inner - 1.0) <= INNER and abs(amplitude.value / self.amplitude - 1.0) <= AMPLITUDE
        )
        return close and self.found.input == self.source and self.found.family == "periodic"

    def __str__(self) -> str:
        """Injected against found."""
        injected = f"injected {self.amplitude:.4g}·sin({self.inner:.4g}·{self.source} + ...) N*m"
        if self.found is None:
            return f"{injected}; no component was found"
        return f"{injected}; found {self.found.equation} ({self.found.conditions})"


def shaking(fault: Unbalance, inertia: float, reports: Sequence[ReportDocument]) -> Shaking:
    """An unbalance of a shaft with ``inertia`` (kg·m²) against the components of the last report."""
    source, inner = ("t", fault.frequency or 0.0) if fault.order is None else ("angle(omega)", fault.order)

    def distance(entry: ComponentDocument) -> float:
        return abs(list(entry.values.values())[1].value - inner)

    periodic = [entry for entry in (reports[-1].components if reports else ()) if entry.family == "periodic"]
    return Shaking(source, inner, fault.acceleration * inertia, min(periodic, key=distance, default=None))
