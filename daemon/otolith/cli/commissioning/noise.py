"""``otolith noise``: noise levels and delays from recorded data of a healthy machine, as lines of its machine file."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import click

from otolith.cli.common import AS_JSON, DATA_FILES, MACHINE_FILE, echo_warnings, progress_line
from otolith.cli.terminal import echo, echo_json
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.grammars.toml_lines import toml_key, toml_value

if TYPE_CHECKING:
    from otolith.acquisition.window import Window
    from otolith.commissioning.delays import IdentifiedDelays
    from otolith.commissioning.identification import IdentifiedNoise, NoiseLevel
    from otolith.commissioning.structure import Structure
    from otolith.machine import LoadedMachine
    from otolith.twin.definition import Input
    from otolith_drivers.replay.readers import Reader


@click.command()
@MACHINE_FILE
@DATA_FILES
@click.option("--windows", type=click.IntRange(1, 1000), default=30, help="Use at most so many, spread over the data.")
@AS_JSON
def noise(file: Path, data: tuple[Path, ...], windows: int, as_json: bool) -> None:
    """Identify noise and delays of the machine in FILE from DATA.

    DATA is recorded from the healthy machine in motion, in formats of 'otolith replay': one file, or several of which
    each is a recording of its own. The output replaces the
    tables [noise] and [process_noise] of FILE. Delays of signals against each other belong into [signals].

    \b
    Examples:
      otolith noise my-machine.toml monday.csv
      otolith noise my-machine.toml monday.csv tuesday.csv --windows 100 --json
    """
    from otolith.machine import load_machine

    machine = load_machine(file, with_driver=False)
    machine.try_fmu()
    record = identified_record(machine, HealthyLog(data), windows)
    if as_json:
        echo_json(_document(machine, record), indent=2)
    else:
        lines = [*noise_lines(machine, record.noise), *structure_lines(machine, record.structure), ""]
        echo(*lines, *delay_lines(machine, record.delays))


class UnusableData(ConfigurationError):  # noqa: N818 - it names the data
    """Data of the healthy machine that are missing, cannot be read, or identify nothing."""


class HealthyData(Protocol):
    """Data of the healthy machine, which may be read several times."""

    @property
    def path(self) -> Path:
        """The file or folder that messages name."""

    @property
    def told(self) -> set[str]:
        """What a person was warned of already."""

    def opened(self, machine: "LoadedMachine") -> "Reader":
        """Return a reader of the signals of ``machine``; raise ConfigurationError if there is nothing to read."""


@dataclass(frozen=True, slots=True)
class HealthyLog:
    """A log, or several, of which each is a recording of its own."""

    files: tuple[Path, ...]
    told: set[str] = field(default_factory=set, compare=False)

    @property
    def path(self) -> Path:
        """The names of the files."""
        return self.files[0].with_name(", ".join(file.name for file in self.files))

    def opened(self, machine: "LoadedMachine") -> "Reader":
        """See :class:`HealthyData`."""
        from otolith.runtime.replay import open_recordings

        return open_recordings(machine, self.files)


@dataclass(frozen=True, slots=True)
class HealthySpan:
    """What a daemon has recorded from ``begin`` to ``end`` (Unix s)."""

    machine: "LoadedMachine"
    begin: float
    end: float
    told: set[str] = field(default_factory=set, compare=False)

    @property
    def path(self) -> Path:
        """The folder of the recordings."""
        return self.machine.recording_folder

    def opened(self, machine: "LoadedMachine") -> "Reader":
        """See :class:`HealthyData`."""
        from otolith.runtime.replay import open_span

        return open_span(machine, self.begin, self.end)


@dataclass(frozen=True, slots=True)
class HealthyRecord:
    """What was identified from a record of the healthy machine."""

    delays: "IdentifiedDelays"
    noise: "IdentifiedNoise"
    structure: "Sequence[Structure]"  # Components that all windows show and the twin lacks
    windows: "Sequence[Window]"  # Without the delays

    @property
    def offered(self) -> "list[Structure]":
        """The structure that can be in the twin from the first window on."""
        return [item for item in self.structure if item.is_offered]

    def noise_beside(self, machine: "LoadedMachine") -> "IdentifiedNoise":
        """The noise levels with the structure in the twin."""
        from otolith.commissioning.identification import identify_noise
        from otolith.estimation.problem import augment

        with progress_line("noise beside the structure") as show:
            wider = augment(machine.problem, [item.component for item in self.offered])
            return identify_noise(wider, self.windows, progress=show)


def identified_record(machine: "LoadedMachine", data: HealthyData, count: int) -> HealthyRecord:
    """Identify delays, noise and structure from ``count`` windows; raise UnusableData if none can be used."""
    from otolith.commissioning.delays import identify_delays_and_noise, without_delays
    from otolith.commissioning.identification import identify_noise
    from otolith.commissioning.structure import remaining_structure

    with progress_line("reading") as show:
        declared = {name: table.delay for name, table in machine.signal_tables.items()}
        chosen = good_windows(machine, data, count)
        delays, identified = identify_delays_and_noise(machine.problem, chosen, declared, progress=show)
        problem, punctual = machine.problem, delays.applied(machine.problem, chosen)
        structure = remaining_structure(problem, identified, punctual, show)
        record = HealthyRecord(delays, identified, structure, punctual)
        if structure and any(signal.is_late for signal in delays.signals):
            # What the twin lacks has looked like a delay if it is still there with the delay.
            without = delays.noise_without or identify_noise(problem, chosen, show)
            beside = remaining_structure(problem, without, chosen, show)
            if {item.component.key for item in beside} & {item.component.key for item in structure}:
                record = HealthyRecord(without_delays(delays, declared), without, beside, chosen)
    if machine.problem.open_loop:
        echo(f"{machine.path}: open_loop is true, so the process noise will not be used", err=True)
    if not identified.windows:
        raise UnusableData(f"{data.path}: {'; '.join(identified.remarks)}")
    return record


def warn_once(machine: "LoadedMachine", data: HealthyData, lines: Iterable[str]) -> None:
    """Print what a replay of ``data`` warns of, but for what an earlier one has."""
    from otolith.health.times import in_local_time

    local = [in_local_time(line, machine.plan.timezone) for line in lines]
    echo_warnings(data.path, [line for line in local if line not in data.told])
    data.told.update(local)


def good_windows(machine: "LoadedMachine", data: HealthyData, count: int) -> list["Window"]:
    """At most ``count`` good windows, spread over the data; raise UnusableData, with why, if there is none."""
    from otolith.runtime.preview import EvenSpread
    from otolith.runtime.replay import Replay

    reasons: tuple[str, ...] = ()
    spread = EvenSpread["Window"](count)
    try:
        with data.opened(machine) as recorded:
            run = Replay(machine, recorded)
            for window in run.windows():
                if window.quality.reasons:
                    reasons = window.quality.reasons
                else:
                    spread.add(window)
            warn_once(machine, data, run.warnings())
    except ConfigurationError as error:
        raise UnusableData(str(error), error.key) from error
    if not (chosen := spread.chosen()):
        length = f"no window of {machine.file.window.length:g} s can be used"
        raise UnusableData(f"{data.path}: {length}: {'; '.join(reasons) or 'the data is too short'}")
    return chosen


def level_rows(
    machine: "LoadedMachine", identified: "IdentifiedNoise", *, is_written: bool = False
) -> dict[str, list[tuple[str, str, str]]]:
    """Return what belongs into the tables [noise] and [process_noise]: keys, values and remarks.

    What ``is_written`` into a file has no level that the data do not determine: that of the file stays.
    """
    twin, problem = machine.twin, machine.problem
    inputs = zip(twin.inputs, identified.applied(problem).levels, strict=False)
    shown = {source.name for source in identified.inputs if source.is_significant}

    def kept(levels: "Sequence[NoiseLevel]") -> "list[NoiseLevel]":
        return [level for level in levels if not is_written or level.sd is not None]

    rows = [_row(level, twin.unit_of(level.name)) for level in kept(identified.outputs)]
    rows += [
        _input_row(machine, identified, source, level)
        for source, level in inputs
        if level and (not is_written or source.name in shown)
    ]
    process = [_row(level, f"{twin.unit_of(level.name)}/s^0.5") for level in kept(identified.states)]
    return {"noise": rows, "process_noise": process}


def noise_lines(machine: "LoadedMachine", identified: "IdentifiedNoise") -> Iterator[str]:
    """The tables ``[noise]`` and ``[process_noise]``, with uncertainties and remarks as comments."""
    from otolith.health.times import in_local_time
    from otolith_drivers.errors import counted

    tables = level_rows(machine, identified)
    yield "[noise]"
    yield from _aligned(tables["noise"])
    inputs = zip(machine.twin.inputs, identified.applied(machine.problem).levels, strict=False)
    measured = (source for source, level in inputs if not level and source.hold == "foh")
    yield from (f"# {source.name}: {_input_row(machine, identified, source, 0.0)[2]}" for source in measured)
    yield ""
    yield "[process_noise]"
    yield from _aligned(tables["process_noise"])
    yield ""
    yield f"# identified from {counted(identified.windows, 'window')} of {machine.file.window.length:g} s"
    consistency = identified.consistency
    if consistency.before is not None and consistency.after is not None:
        after = f", now {consistency.after:.3g}" if consistency.after != consistency.before else ""
        factor = f"; process noise times {consistency.factor:.3g}" if (consistency.factor or 1.0) != 1.0 else ""
        yield f"# chi-square between windows, per degree of freedom: {consistency.before:.3g}{after}{factor}"
    yield f"# {consistency.remark}"
    yield from _whiteness_lines(identified)
    yield from (f"# {in_local_time(remark, machine.plan.timezone)}" for remark in identified.remarks)


def _input_row(
    machine: "LoadedMachine", identified: "IdentifiedNoise", source: "Input", level: float
) -> tuple[str, str, str]:
    """Key and value of the noise of an input, and its comment: why it is not identified, if it is not."""
    from otolith.commissioning.identification import driven_states

    line = source.name, f"{level:.3g} {source.unit}"
    shown = next((row for row in identified.inputs if row.name == source.name), None)
    if shown is not None and shown.is_significant:
        return *line, f"± {shown.level_sd / shown.level:.1%}"
    states = driven_states(machine.twin, source.name)
    contain = f"process noise of {' and '.join(states)}" if states else "noise of the outputs"
    acts = f"it cannot be told from {contain}: the level there includes it"
    if shown is None:
        return *line, f"not identifiable: {acts}"
    return *line, f"not significant: up to about {shown.limit:.1g} {source.unit} cannot be detected; {acts}"


def _whiteness_lines(identified: "IdentifiedNoise") -> Iterator[str]:
    """The tests of the innovations, and the spectrum of those that are not white, as comments."""
    inflated = bool(identified.whiteness_after)
    stages = [(identified.whiteness, " before inflation" if inflated else ""), (identified.whiteness_after, "")]
    for rows, when in stages:
        for row in rows:
            at = f"correlation {row.correlation:.2g} at {row.lag:.3g} s"
            yield f"# innovations of {row.output}{when}: {'white' if row.is_white else f'coloured, {at}'}"
            if not row.is_white and row.bands:
                bands = (f"{band.ratio:.2g} to {band.high:.3g} Hz" for band in row.bands)
                yield f"#   power over that of white noise, from {row.bands[0].low:.3g} Hz: {', '.join(bands)}"
    if inflated and not all(row.is_white for row in identified.whiteness):
        yield "# process noise stands for what the twin lacks and may bias parameters: replay without it for the causes"


def structure_lines(machine: "LoadedMachine", structure: "Sequence[Structure]") -> Iterator[str]:
    """What all windows show and the twin lacks, as comments."""
    from otolith.estimation.problem import equation, site_of
    from otolith.health.text import interval_text

    for item in structure:
        component = item.component
        values = (component.amplitude, component.inner, component.phase)
        text = equation(machine.twin, component, values[: 2 if item.is_restarted else 3])
        again = f", again every {_repeat(machine, item)}" if component.periodic else ""
        amplitude = interval_text(component.amplitude, item.sd, site_of(machine.twin, component.site).unit)
        yield f"# structure: {component.key}: {text} (amplitude {amplitude}){again}"
        if item.is_at_bound:
            yield f"# its {_inner_meaning(item)} lies at a bound of the search, so its shape is not known: not offered"
    if structure:
        yield "# the twin lacks it in all windows alike, and the process noise above contains it"
    if any(item.is_offered for item in structure):
        yield "# otolith commission asks whether it belongs to the healthy machine, and identifies the noise without it"


def _inner_meaning(item: "Structure") -> str:
    inner = item.component.model.inner
    return "value" if inner is None else inner.meaning


def _repeat(machine: "LoadedMachine", item: "Structure") -> str:
    """The period of a periodic component in the unit of its source."""
    from math import pi

    from otolith.estimation.problem import source_of

    unit = source_of(machine.twin, item.component.source).unit
    return f"{2.0 * pi / item.component.inner:.4g} {unit}"


def delay_lines(machine: "LoadedMachine", delays: "IdentifiedDelays") -> Iterator[str]:
    """The keys ``delay`` of the table ``[signals]``, with uncertainties and remarks as comments.

    A machine file that describes its signals has the table already, so the lines are comments.
    """
    late = [signal for signal in delays.signals if signal.is_late and signal.sd is not None]
    rows = []
    for late_signal in late:
        uncertainty = f"± {2e3 * (late_signal.sd or 0.0):.2g} ms"
        value = {"delay": f"{1e3 * late_signal.value:.4g} ms"}
        rows.append((late_signal.name, value, "; ".join(filter(None, [uncertainty, late_signal.remark]))))
    if late and machine.file.read_signals:
        yield "# under [signals], add the key delay to what is there:"
        yield from (f"# {line}" for line in _aligned(rows))
    elif late:
        yield "[signals]"
        yield from _aligned(rows)
    yield from (f"# {item.name}: {item.remark}" for item in delays.signals if item.remark and item not in late)


def _row(level: "NoiseLevel", unit: str) -> tuple[str, str, str]:
    """A key of the machine file with its value, and its comment."""
    is_known = level.sd is not None and level.value and not level.is_bound
    uncertainty = f"± {level.sd / level.value:.1%}" if level.sd is not None and is_known else ""
    return level.name, f"{level.value:.3g} {unit}", "; ".join(filter(None, [uncertainty, level.remark]))


def _aligned(rows: Sequence[tuple[str, Any, str]]) -> list[str]:
    lines = [f"{toml_key(name)} = {toml_value(value)}" for name, value, _ in rows]
    width = max(map(len, lines), default=0)
    return [f"{line:{width}}  # {row[-1]}" if row[-1] else line for line, row in zip(lines, rows, strict=True)]


def _document(machine: "LoadedMachine", record: HealthyRecord) -> dict[str, Any]:
    from dataclasses import asdict

    units = machine.twin.units()
    document = asdict(record.noise)
    for level in (*document["outputs"], *document["inputs"]):
        level["unit"] = units[level["name"]]
    for level in document["states"]:
        level["unit"] = f"({units[level['name']]})/s^0.5"
    document["structure"] = [asdict(item) | {"key": item.component.key} for item in record.structure]
    document["delays"] = [asdict(delay) | {"unit": "s"} for delay in record.delays.signals]
    return document
