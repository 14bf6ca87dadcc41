"""The adapted twin for notebooks: ``from otolith import Twin``. docs/simulate.md shows how it is used.

Nothing here changes what a daemon has learned or writes a file: each method returns a new twin, or numbers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from otolith.acquisition.quality import is_of_calendar
from otolith.acquisition.window import Array, Window
from otolith.adaptation.open_causes import possible_posteriors
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.estimation.information import QUANTILE
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import amplitude_indices, equation, indices
from otolith.estimation.window_fit import fit_predicted
from otolith.exchange.export_modelica import modelica_text
from otolith.exchange.export_python import python_text
from otolith.exchange.exported import ExportedTwin, exported_twin
from otolith.health.labels import TimeLabels
from otolith.health.prognosis import forecast, with_baselines
from otolith.health.times import moment_text
from otolith.machine import LoadedMachine, load_machine
from otolith.notebook_arguments import is_table, path_of, plan_of, seconds_of, seed_of, span_of, text_of
from otolith.runtime.replay import Replay, open_recordings
from otolith.runtime.simulation_inputs import PlannedRows, RecordedStretch, read_inputs, read_recorded
from otolith.simulation import what_if
from otolith.simulation.initial_state import after_window
from otolith.simulation.plan import joined, planned_window
from otolith.simulation.prediction import Prediction
from otolith.simulation.simulate import simulate, substeps_of
from otolith.storage.history import MINUTE, RESOLUTIONS, HistoryReader, HistorySample, history_path
from otolith.storage.state_store import store_of
from otolith_drivers.errors import ConfigurationError, shown
from otolith_drivers.units import quantity_text

DIVERGES = "supposed values, or inputs far outside of their ordinary range, are the likely cause"


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """A parameter of the twin as it is known now.

    Attributes:
        name: as in the twin file; of an amplitude or another value of a component what it is of.
        value: in ``unit``.
        sd: standard deviation, in ``unit``; 0 of one that is given.
        low: lower end of the 95 % interval, in ``unit``.
        high: upper end of the 95 % interval, in ``unit``.
        unit: as in the twin file, ``1`` for a number without unit.
        trend_per_hour: in ``unit`` per hour; 0 of one that is given.
        is_estimated: false of a parameter whose value the machine file or a person gives.
        meaning: what it is, for people.
    """

    name: str
    value: float
    sd: float
    low: float
    high: float
    unit: str
    trend_per_hour: float
    is_estimated: bool
    meaning: str

    def __str__(self) -> str:
        """Name, value with its 95 % interval, and meaning, in a line."""
        half = QUANTILE * self.sd if self.sd else None
        return f"{self.name} = {quantity_text(self.value, self.unit, half)}, {self.meaning}"


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """A recording beside what the twin predicts from one record to the next.

    Attributes:
        outputs: names of the outputs, the columns of the arrays.
        units: of the outputs.
        times: (records,) s, as in the recording.
        measured: (records, outputs) each in its unit; not-a-number where nothing was measured.
        predicted: (records, outputs) each in its unit.
        normalised: (records, outputs) measured minus predicted in standard deviations: independent standard normal
            deviates, if the twin explains the recording.
    """

    outputs: tuple[str, ...]
    units: tuple[str, ...]
    times: Array
    measured: Array
    predicted: Array
    normalised: Array

    @property
    def values(self) -> Array:
        """(records, outputs) measured minus predicted, each in its unit."""
        return self.measured - self.predicted

    def rms(self) -> dict[str, float]:
        """Return the root mean square of the residuals by output, in standard deviations: 1 for noise alone."""
        present = np.isfinite(self.measured)
        sums = np.where(present, self.normalised, 0.0) ** 2
        rms = np.sqrt(sums.sum(axis=0) / np.maximum(present.sum(axis=0), 1))
        return dict(zip(self.outputs, rms.tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class Twin:
    """The adapted twin of one machine: its equations, discovered components, parameters with intervals, and state.

    ``Twin.load`` has what a daemon has learned. All values are in the units of the twin file: see
    :attr:`parameters`, :attr:`inputs` and :attr:`outputs`. A wrong argument is a ConfigurationError that names it.

    Attributes:
        machine: the machine file, loaded.
        learned: what was learned of the machine.
        posterior: the same of parameters and components, with what a person supposes.
        labels: the Unix times of the times that the daemon counts, both in s.
        supposed: what a person supposes of the machine, a line each.
    """

    machine: LoadedMachine
    learned: AdaptationState
    posterior: Posterior
    labels: TimeLabels = field(default_factory=TimeLabels)
    supposed: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: str | Path) -> "Twin":
        """Return the twin of the machine file at ``path`` with what its daemon has learned until now.

        Without a daemon it is as the machine file describes it: :meth:`adapted` adapts it to recordings.

        Raises:
            otolith_drivers.errors.ConfigurationError: the file, or what was learned, cannot be used; it says why.
        """
        fresh = cls.fresh(path)
        store = store_of(fresh.machine)
        plan = with_baselines(fresh.machine.plan, store.decisions().holding(fresh.machine.problem))
        state, reason = store.peek(replace(fresh.learned, plan=plan))
        if reason:
            remedy = "run the daemon, or adapt the twin to a recording: Twin.fresh(...).adapted(...), or --after"
            raise ConfigurationError(f"{store.components_path}: cannot be used: {reason}: {remedy}")
        return cls(fresh.machine, state, state.posterior, store.labels())

    @classmethod
    def fresh(cls, path: str | Path) -> "Twin":
        """Return the twin as the machine file at ``path`` describes it, whatever a daemon has learned.

        Raises:
            otolith_drivers.errors.ConfigurationError: the file cannot be used; it says why.
        """
        machine = load_machine(path_of(path, "path", "a machine file"), with_driver=False)
        machine.try_fmu()
        names = machine.file.machine
        state = initial_state(names.name, names.site, machine.problem, machine.plan)
        return cls(machine, state, state.posterior)

    @property
    def inputs(self) -> dict[str, str]:
        """Unit of each input, by its name."""
        return {item.name: item.unit for item in self.machine.twin.inputs}

    @property
    def outputs(self) -> dict[str, str]:
        """Unit of each output, by its name."""
        return {item.name: item.unit for item in self.machine.twin.outputs}

    @property
    def components(self) -> dict[str, str]:
        """Equation of each discovered component, by its key."""
        problem, values = self.posterior.problem, self.posterior.start()
        return {
            component.key: equation(problem.base_model, component, values[indices(problem, slot)].tolist())
            for slot, component in enumerate(problem.components)
        }

    @property
    def parameters(self) -> tuple[ParameterRow, ...]:
        """All parameters of the twin, in the order of its file, then those of components."""
        problem, prior = self.posterior.problem, self.posterior.prior()
        known, count = dict(problem.known) | what_if.supposed_values(self.posterior), len(problem.free)
        free = {item.name: index for index, item in enumerate(problem.free)}
        rows = []
        for item in (*problem.base_model.parameters, *(item for item in problem.free if item.name.startswith("_"))):
            index = free.get(item.name)
            if item.name in known or index is None:
                value = known[item.name]
                rows.append(ParameterRow(item.name, value, 0.0, value, value, item.unit, 0.0, False, item.meaning))
                continue
            value, sd = float(prior.mean[index]), float(prior.sd[index])
            trend, reach = 3600.0 * float(prior.mean[count + index]), QUANTILE * sd
            name = item.label if item.name.startswith("_") else item.name
            ends = value - reach, value + reach
            rows.append(ParameterRow(name, value, sd, *ends, item.unit, trend, True, item.meaning))
        return tuple(rows)

    @property
    def time(self) -> float | None:
        """Unix time of the last record that was learned from, s, or the time in its recording; None without one."""
        phase = self._possible[0][1].phase
        return None if phase is None else self.labels.unix(phase.next_start - self._period)

    @property
    def _possible(self) -> tuple[tuple[float, Posterior], ...]:
        """What is known under each cause that is possible, with what a person supposes, and its probability."""
        if self.learned.test is None:
            return ((1.0, self.posterior),)
        return tuple((share, self._supposed_of(each)) for share, each in possible_posteriors(self.learned))

    @property
    def _period(self) -> float:
        return self.machine.file.window.sample_period

    def adapted(self, *recordings: str | Path) -> "Twin":
        """Return the twin after ``recordings``, each in a form that ``otolith replay`` reads.

        It begins with what the machine file states and the operator decided of components, as a replay does, and not
        with what this twin has learned.

        Raises:
            otolith_drivers.errors.ConfigurationError: a recording cannot be used, or is too short for a window.
        """
        if not recordings:
            raise ConfigurationError("recordings: none: give the path of at least one")
        paths = [path_of(item, "recordings", "a recording, or several one after the other") for item in recordings]
        with open_recordings(self.machine, paths) as reader:
            replay = Replay(self.machine, reader)
            replay.state = store_of(self.machine).decided(replay.state)
            for _ in replay.reports():
                pass
        return Twin(self.machine, replay.state, replay.state.posterior)

    def at(self, time: float | datetime) -> "Twin":
        """Return the twin with parameters and amplitudes as they were at a ``time``, from its history.

        ``time`` is in Unix s, or a datetime with its zone.

        The history has their intervals, but neither correlations nor trends: trends keep the uncertainty that they have
        now, around zero. Components that were not in the twin then are left out. The state is that of now.

        Raises:
            otolith_drivers.errors.ConfigurationError: there is no history, or no value of that time.
        """
        time = seconds_of(time, "time")  # Unix s
        names, posterior = self.machine.file.machine, self.posterior
        known = _values_at(HistoryReader(history_path(names.site, names.name)), time)
        for key in self.components:
            if key not in known:
                posterior = what_if.without_component(posterior, key)
        problem, prior = posterior.problem, posterior.prior()
        amplitudes = {index: problem.components[slot].key for slot, index in enumerate(amplitude_indices(problem))}
        when = _moment_text(time, self.learned.plan.timezone)
        for index, item in enumerate(problem.free):
            if item.name.startswith("_") and index not in amplitudes:
                continue
            sample = known.get(amplitudes.get(index, item.name))
            if sample is None or sample.low is None or sample.high is None:
                remedy = "'otolith history' shows of which times there are values"
                raise ConfigurationError(f"no value of {item.label} in the history at {when}: {remedy}")
            sd, trend = 0.5 * (sample.high - sample.low) / QUANTILE, len(problem.free) + index
            posterior = posterior.reset_value(index, sample.last, sd).reset_value(trend, 0.0, float(prior.sd[trend]))
        learned = replace(self.learned, posterior=posterior, test=None)
        return replace(self, learned=learned, posterior=posterior, supposed=(*self.supposed, f"values of {when}"))

    def with_value(self, name: str, value: str | float) -> "Twin":
        """Return the twin with a parameter known to be ``value``: a number in its unit, or a text like "5.2 ohm".

        Raises:
            otolith_drivers.errors.ConfigurationError: there is no such parameter, or it cannot have this value.
        """
        name = text_of(name, "name", "R_a")
        posterior = what_if.with_value(self.posterior, name, value)
        row = next(row for row in self._supposing(posterior, "").parameters if row.name == name)
        kept = tuple(line for line in self.supposed if not line.startswith(f"{name} = "))
        return replace(self, supposed=kept)._supposing(posterior, f"{name} = {quantity_text(row.value, row.unit)}")

    def without(self, component: str) -> "Twin":
        """Return the twin without a component, by its key in :attr:`components`, or the begin of it.

        Raises:
            otolith_drivers.errors.ConfigurationError: there is no such component, or several.
        """
        component = text_of(component, "component", "shaft/periodic")
        return self._supposing(what_if.without_component(self.posterior, component), f"without {component}")

    def at_limit(self) -> "Twin":
        """Return the twin when its next limit is passed, if the trends in its history go on.

        That is the ACT limit that is passed first, or the WATCH limit where none leads to ACT. The parameter then has
        the value of the limit; all others keep theirs.

        Raises:
            otolith_drivers.errors.ConfigurationError: no parameter is on its way to a limit; it says why of each.
        """
        crossings, reasons = [], []
        for name, quantity in self.learned.plan.parameters.items():
            history = self.learned.health.histories.get(name, ())
            if not quantity.limits or not history:
                reasons.append(f"{name}: {'no estimates yet' if quantity.limits else 'no limits'}")
                continue
            found = forecast(quantity, history)
            reasons += [f"{name}: {found.reason}"] if found.reason else []
            both = {"ACT": found.act, "WATCH": found.watch}
            crossings += [(level, item.at, name, item) for level, item in both.items() if item is not None]
        if not crossings:
            listed = "; ".join(reasons) or "the machine file has no limits"
            raise ConfigurationError(f"no parameter is on its way to a limit ({listed}): set a value instead")
        level, at, name, crossing = min(crossings, key=lambda item: item[:3])  # "ACT" comes first
        posterior = what_if.with_value(self.posterior, name, crossing.limit)
        value = quantity_text(crossing.limit, self.learned.plan.parameters[name].unit)
        when = _moment_text(self.labels.unix(at), self.learned.plan.timezone)
        return self._supposing(posterior, f"{name} = {value}, its {level} limit, expected at {when}")

    def _supposing(self, posterior: Posterior, line: str) -> "Twin":
        return replace(self, posterior=posterior, supposed=(*self.supposed, line))

    def simulate(
        self,
        inputs: str | Path | Mapping[str, Any] | Any = None,
        *,
        seed: int = 1,
        span: tuple[float, float] | None = None,
    ) -> Prediction:
        """Return what the twin predicts along ``inputs``, with 95 % bands of the readings.

        ``inputs`` is a plan: a table with a column ``t`` (s, or dates with their zone) and one for each input. It is in
        a file, or a mapping from names to sequences of numbers (rows,), or a table of pandas or pyarrow. ``V_a`` is in
        the unit of :attr:`inputs`, ``V_a [mV]`` in that of its name; other columns are not used. Or it is the path of a
        recording, of which ``span`` (s, as its times) may choose a part. Without ``inputs``, ``span`` (Unix s) is of
        what the daemon has recorded.

        A plan begins at :attr:`time`. A recording begins with a window that shows the state of the machine, and is
        predicted from there on.

        The result has ``times`` (records,), ``values``, ``low``, ``high`` and ``measured`` (records, outputs). The same
        ``seed``, a whole number from 0 on, gives the same numbers.

        Raises:
            otolith_drivers.errors.ConfigurationError: the inputs cannot be used, or no window was learned from yet.
        """
        seed, ends = seed_of(seed), None if span is None else span_of(span)
        if is_table(inputs):
            if ends is not None:
                raise ConfigurationError("span: a plan is used as a whole: leave the span out")
            times, columns = plan_of(inputs, self.inputs)
            return self.simulate_along(PlannedRows(Path("inputs"), times, columns), seed=seed)
        if inputs is not None:
            what = "a plan or a recording, or a dict or a table of pandas or pyarrow"
            source = read_inputs(self.machine, path_of(inputs, "inputs", what), ends)
            return self.simulate_along(source, seed=seed)
        if ends is None:
            raise ConfigurationError("inputs: give a plan, a recording, or the span of what the daemon has recorded")
        return self.simulate_along(read_recorded(self.machine, ends), seed=seed)

    def simulate_along(self, source: PlannedRows | RecordedStretch, *, seed: int = 1) -> Prediction:
        """Return the same as :meth:`simulate` for inputs that were read; raises as it."""
        if not isinstance(source, PlannedRows | RecordedStretch):
            raise ConfigurationError(f"source: {shown(source)}: give what was read, or call simulate")
        possible, phase = self._possible, self._possible[0][1].phase
        if isinstance(source, PlannedRows):
            start, begin = 0.0 if phase is None else phase.next_start - self._period, float(source.times[0])
            try:
                window = planned_window(self.machine.twin, source.times, source.columns, self._period, start)
            except ValueError as error:
                raise ConfigurationError(f"{source.path}: {error}") from error
        try:
            if not isinstance(source, PlannedRows):
                possible, window, begin = self._after_lead(source)
            prediction = simulate(possible, window, seed)
        except ValueError as error:
            remedy = "run the daemon, or adapt the twin to a recording" if phase is None else DIVERGES
            raise ConfigurationError(f"{source.path}: {error}: {remedy}") from error
        return replace(prediction, start=begin)

    def _after_lead(self, stretch: RecordedStretch) -> tuple[tuple[tuple[float, Posterior], ...], Window, float]:
        """Return what is possible after the first usable window of a recording, the rest, and the time of its begin.

        What a person supposes holds in the rest only. A recording that is not after what was learned counts as if it
        were: phases of components are then unknown before the first window.
        """
        possible, first = possible_posteriors(self.learned), stretch.windows[0]
        end = max(known.belief.end for _, known in possible)
        by = -self.labels.ahead(end) if np.isfinite(end) else 0.0
        if np.isfinite(end) and first.start + by < end - 0.5 * first.sample_period:
            by = end + first.grid.length - first.start
        windows = [replace(window, start=window.start + by) for window in stretch.windows]
        lead = stretch.lead()
        rest = joined([windows[lead].since(windows[lead].records - 1), *windows[lead + 1 :]])
        after = tuple((share, self._supposed_of(after_window(known, windows[lead]))) for share, known in possible)
        return after, rest, rest.start - by

    def _supposed_of(self, posterior: Posterior) -> Posterior:
        """Return a later posterior of the same machine with what a person supposes."""
        own, before = self.posterior, self.learned.problem
        kept = {item.key for item in own.problem.components}
        for key in [item.key for item in before.components if item.key not in kept]:
            if key in {item.key for item in posterior.problem.components}:
                posterior = what_if.without_component(posterior, key)
        known = dict(before.known)
        values = {name: value for name, value in own.problem.known if known.get(name, value) != value}
        values |= what_if.supposed_values(own)
        for name, value in values.items():
            posterior = what_if.with_value(posterior, name, value)
        return posterior

    def residuals(self, recording: str | Path) -> Residuals:
        """Return measured and predicted outputs of a ``recording``, from each record to the next one.

        In each window the state at its begin is estimated, and parameters stay within what is known of them.

        Raises:
            otolith_drivers.errors.ConfigurationError: the recording cannot be used.
        """
        source = read_inputs(self.machine, path_of(recording, "recording", "a recording"))
        if isinstance(source, PlannedRows):
            raise ConfigurationError(f"{recording}: has not all outputs of the twin: {', '.join(self.outputs)}")
        posterior, parts, names = self.posterior, [], tuple(self.outputs)
        for window in source.windows:
            end = posterior.belief.end if np.isfinite(posterior.belief.end) else window.end
            here = replace(window, start=end - window.grid.length)
            fitted = fit_predicted(posterior.predict(here), posterior.problem, here)
            predicted, _ = fitted.predict()
            parts.append((window.start + window.grid.offsets, window.measured(names), predicted, fitted.innovations))
        times, measured, predicted, normalised = (np.concatenate(column) for column in zip(*parts, strict=True))
        return Residuals(names, tuple(self.outputs.values()), times, measured, predicted, normalised)

    def python(self) -> str:
        """Return the twin as a Python program that needs NumPy alone: equations, values with intervals, an integrator.

        Raises:
            otolith_drivers.errors.ConfigurationError: no window was learned from yet.
        """
        twin, notes = self._exported()
        return python_text(twin, notes, substeps_of(self.posterior))

    def modelica(self) -> str:
        """Return the twin as a Modelica model; raises as :meth:`python`."""
        twin, notes = self._exported()
        return modelica_text(twin, notes, f"{self.machine.file.machine.name}_adapted")

    def fmu(self, version: Literal["2", "3"] = "2") -> bytes:
        """Return the twin as an FMU of FMI 2.0 or 3.0 for co-simulation and model exchange: the content of the file.

        Raises:
            otolith_drivers.errors.ConfigurationError: no window was learned from yet, or there is no C compiler.
        """
        from otolith.exchange.fmu import Stepping, fmu_files  # noqa: PLC0415 - loads SymPy
        from otolith.exchange.model_description import Version  # noqa: PLC0415 - the same
        from otolith.runtime.fmu_archive import fmu_archive  # noqa: PLC0415 - the same

        if version not in (known := [item.value for item in Version]):
            raise ConfigurationError(f"version: {shown(version)}: give one of {', '.join(map(repr, known))}")
        twin, notes = self._exported()
        kernel, name = Stepping(self._period, substeps_of(self.posterior)), self.machine.file.machine.name
        return fmu_archive(fmu_files(twin, notes, Version(version), kernel, name))

    def _exported(self) -> tuple[ExportedTwin, tuple[str, ...]]:
        """Return what is exported, and of which machine and time it is."""
        try:
            twin = exported_twin(self.posterior)
        except ValueError as error:
            remedy = "run the daemon, or adapt the twin to a recording"
            raise ConfigurationError(f"{self.machine.path}: {error}: {remedy}") from error
        when = _moment_text(self.time or 0.0, self.learned.plan.timezone)
        supposed = tuple(f"Supposed: {line}" for line in self.supposed)
        return twin, (f"Machine: {self.machine.title}, learned until {when}.", *supposed)

    def __str__(self) -> str:
        """Machine, parameters and components, a line each."""
        lines: Sequence[str] = [self.machine.title, *map(str, self.parameters)]
        components = [f"{key}: {text}" for key, text in self.components.items()]
        return "\n".join([*lines, *components, *(f"supposed: {line}" for line in self.supposed)])


def _moment_text(seconds: float, zone: str | None) -> str:
    """Return a Unix time in a zone, or the time of a log without dates."""
    return moment_text(seconds, zone) if is_of_calendar(seconds) else f"t = {seconds:.6g} s"


def _values_at(reader: HistoryReader, time: float) -> dict[str, HistorySample]:
    """Return the value of each parameter, and of each amplitude by the key of its component, that held at ``time``.

    Of each the finest resolution that is kept counts, and of that the value whose time is nearest: an interval has the
    value at its end, which is up to a day after its begin. Raises as the reader.
    """
    found: dict[str, HistorySample] = {}
    for resolution in RESOLUTIONS:
        reach = resolution or MINUTE
        own: dict[str, tuple[float, HistorySample]] = {}
        for sample in reader.samples(resolution, time - 2.0 * reach):
            age = time - (sample.time + resolution)  # the time of a window is its end
            is_then = 0.0 <= age <= reach or (resolution and -reach < age < 0.0)
            if is_then and abs(age) <= own.get(sample.name, (reach, sample))[0]:
                own[sample.name] = abs(age), sample
        found = {name: sample for name, (_, sample) in own.items()} | found
    return found
