"""``otolith commission``: what is normal for a machine, from a log of it or while its daemon runs."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from otolith.cli.commissioning.components import equation_of, key_of_record, loaded
from otolith.cli.common import ANY_DATA_FILES, MACHINE_FILE, local_time, progress_line, restart_command
from otolith.cli.operation.baseline import keep_baseline
from otolith.cli.operation.history import Since, age_or_date
from otolith.cli.terminal import echo

if TYPE_CHECKING:
    from otolith.adaptation.state import AdaptationState, ComponentRecord, OperatorDecisions
    from otolith.cli.commissioning.machine_lines import NewLine
    from otolith.cli.commissioning.noise import HealthyData
    from otolith.commissioning.constancy import ValueChange
    from otolith.commissioning.delays import IdentifiedDelays
    from otolith.commissioning.identification import IdentifiedNoise
    from otolith.commissioning.value_search import OwnValue, OwnValues
    from otolith.health.prognosis import History
    from otolith.machine import LoadedMachine
    from otolith.storage.history import HistoryReader
    from otolith.storage.state_store import StateStore
    from otolith.twin.definition import Parameter

# Engineering choices, see docs/reference/thresholds-cli.md.
WINDOWS = 30  # of which noise, delays and values are identified
REACH = 4.0  # times a healthy value: bounds of its estimate
LOAD_SHARE = 0.5  # of the bounds of an unknown load, beyond which the load of the record makes them wider
REPORTS_AT_ONCE = 1000  # that are read from the history


Decide = Callable[[], bool | None]  # Whether a component belongs to the healthy machine; None: it is left open


@dataclass(frozen=True, slots=True)
class Manner:
    """How a machine is commissioned."""

    decide: Decide  # Asked of each component that was found
    write: bool = False  # Write into the machine file, rather than print
    details: bool = False  # Print each finding


@click.command()
@MACHINE_FILE
@ANY_DATA_FILES
@click.option("--last", callback=lambda *given: given[-1] and age_or_date(*given), metavar="AGE",
              help="Of the machine that runs: it was healthy for so long, like 2h.")  # fmt: skip
@click.option("--since", callback=lambda *given: given[-1] and age_or_date(*given), metavar="AGE|DATE",
              help="The same, from here on.")  # fmt: skip
@click.option("--until", callback=lambda *given: given[-1] and age_or_date(*given), metavar="AGE|DATE",
              help="The same, up to here.  [default: now]")  # fmt: skip
@click.option("--yes", is_flag=True, help="Approve every component that is found.")
@click.option("--write", is_flag=True, help="Write noise, delays and values that FILE does not state into FILE.")
@click.option("--windows", type=click.IntRange(1, 1000), default=WINDOWS, help="At most so many windows for the noise.")
@click.option("--details", is_flag=True, help="Print each finding of the replay, not their number.")
def commission(
    file: Path,
    data: tuple[Path, ...],
    last: Since | None,
    since: Since | None,
    until: Since | None,
    yes: bool,
    write: bool,
    windows: int,
    details: bool,
) -> None:
    """Identify what is normal for the machine in FILE.

    Searches data of the healthy machine for components that the twin lacks, and identifies noise levels and delays of
    signals. You decide for each component whether it belongs to the machine; afterwards only a change is a finding.
    Its estimates become the baseline of limits in percent.

    The data are DATA, a log or several; stop the daemon before. Or they are what the daemon has recorded since a time:
    then it goes on with all that it has learned, and takes over the baseline with its next window.

    With --write, parameters that FILE does not state are identified first.

    \b
    Examples:
      otolith commission my-machine.toml monday.csv --write
      otolith commission my-machine.toml monday.csv --yes
      otolith commission my-machine.toml --last 2h
      otolith commission my-machine.toml --since 2026-01-31T06:00 --until 2h
    """
    spans = [name for name, given in (("--last", last), ("--since", since), ("--until", until)) if given]
    if data and spans:
        raise click.UsageError(f"{spans[0]} is of a machine that runs, not of DATA: give one of them")
    if not data and not (last or since):
        raise click.UsageError("which data are of the healthy machine? give DATA, or --last 2h of a machine that runs")
    if last and since:
        raise click.UsageError("--last and --since both say where it begins: give one of them")
    if data:
        how = Manner((lambda: True) if yes else ask_if_healthy, write=write, details=details)
        commission_log(file, data, windows, how)
        return
    machine, store = loaded(file)
    zone = machine.plan.timezone
    end = until.before(time.time(), zone) if until else time.time()
    begin = (last or since or Since()).before(end if last else time.time(), zone)
    if begin >= end:
        raise click.UsageError(f"it begins at {local_time(begin, zone)}, but ends at {local_time(end, zone)}")
    how = Manner((lambda: True) if yes else ask_if_healthy, write=write, details=details)
    _commission_running(machine, store, (begin, end), windows, how)


def commission_log(file: Path, data: tuple[Path, ...], windows: int, how: Manner) -> None:
    """Commission the machine in ``file`` by logs; the results go to the standard output, or into ``file``."""
    from otolith.cli.commissioning.noise import HealthyLog

    machine, store = loaded(file)
    with store.locked():
        if how.write:
            machine = _with_own_values(machine, HealthyLog(data), windows)
        elif names := [row.name for row in machine.twin.parameters if row.part and row.name not in _stated(machine)]:
            echo(f"{machine.path}: {', '.join(names)}: values of the twin's example; --write determines them", err=True)
        _commission(machine, store, HealthyLog(data), windows, how)


def _with_own_values(machine: "LoadedMachine", data: "HealthyData", windows: int) -> "LoadedMachine":
    """Return the machine with the values that its file does not state, as the data show them; they are written."""
    from otolith.cli.commissioning.machine_lines import with_keys
    from otolith.cli.commissioning.noise import good_windows
    from otolith.commissioning.own_values import own_values
    from otolith.twin.definition import Role
    from otolith.twin.unmeasured import Assumption
    from otolith_drivers.errors import ConfigurationError, counted

    rows = [row for row in machine.twin.parameters if row.role is not Role.SETTING and row.name not in _stated(machine)]
    loads = {item.name for item in machine.unmeasured if item.assumption is Assumption.CONSTANT}
    free = [row for row in rows if row.part or row.role is Role.ESTIMATED]
    if not {row.name for row in free} - loads:
        return machine
    with progress_line("reading") as show:
        chosen = good_windows(machine, data, windows)
        found = own_values(machine.problem, chosen, free, loads, show, stated=_stated(machine))
    reasons = [_refusal(machine, found)] if found.faults or not found.is_followed else []
    if steps := [change for change in found.changes if not change.is_drift]:
        reasons.append(_of_two_states(machine, steps))
    if reasons:
        raise ConfigurationError(f"{data.path}: no value is written: {'; '.join(reasons)}")
    if found.beside:
        echo(f"the log shows {', '.join(found.beside)}, which the twin lacks: fitted with the values", err=True)
    lines, remarks = _value_lines(machine, found, data.path)
    echo(*remarks, err=True)
    rest = [f"{row.name} = {row.nominal:.4g} {row.unit} ({row.meaning})" for row in rows if row not in free]
    if rest:
        echo(f"of the design, as in the twin's example: {', '.join(rest)}: write what your machine has", err=True)
    echo(f"{machine.path}: {counted(len(lines), 'value')} written into [parameters]", err=True)
    return _written(machine, lambda text: with_keys(text, "parameters", lines))


def _refusal(machine: "LoadedMachine", found: "OwnValues") -> str:
    """Return why no value can be taken, and what to do."""
    from otolith.commissioning.value_search import MIN_SHARE

    check = "check columns, units and signs in [signals]"
    if found.is_followed:
        record = "record the machine without what the twin lacks, as an unbalance or a load without a sensor"
        return f"{'; '.join(found.faults)}: {check}, {record}, or take another twin of 'otolith twin list'"
    least = min(found.shares.items(), key=lambda item: item[1], default=None)
    left = "no value is determined"
    if least is not None and least[1] < MIN_SHARE:
        left = f"it explains {max(least[1], 0.0):.0%} of the variance of {least[0]}, of at least {MIN_SHARE:.0%}"
    why = "; ".join(found.faults) or f"twin {machine.twin.name!r} does not describe the machine: {left}"
    return f"{why}: {check}; 'otolith twin list' shows other twins"


def _of_two_states(machine: "LoadedMachine", steps: "Sequence[ValueChange]") -> str:
    """Return which values step within the record, when, and which part of it to take."""
    from otolith.acquisition.quality import time_text
    from otolith.estimation.information import QUANTILE
    from otolith.health.times import in_local_time
    from otolith_drivers.units import quantity_text

    def told(change: "ValueChange") -> str:
        unit = machine.twin.parameter(change.name).unit
        before = quantity_text(change.before, unit, QUANTILE * change.before_sd)
        after = quantity_text(change.after, unit, QUANTILE * change.after_sd)
        return f"{change.name} is {before} until {time_text(change.until or 0.0)} and {after} from {since} on"

    since, until = time_text(steps[0].since or 0.0), time_text(steps[0].until or 0.0)
    remedy = f"give a file that ends before {until}, or one that begins after {since}"
    text = f"{'; '.join(map(told, steps))}: the record is of two states of the machine: {remedy}"
    return in_local_time(text, machine.plan.timezone)


def _stated(machine: "LoadedMachine") -> set[str]:
    """Return the parameters whose values the file states."""
    return {name for name, table in machine.file.parameters.items() if table.value is not None}


def _value_lines(machine: "LoadedMachine", found: "OwnValues", data: Path) -> "tuple[dict[str, NewLine], list[str]]":
    """Return the lines of [parameters] for what was found, and what people must know of it."""
    from otolith.cli.commissioning.machine_lines import NewLine
    from otolith.estimation.information import QUANTILE
    from otolith.health.text import interval_text

    lines, remarks = dict[str, NewLine](), list[str]()
    for item in found.values:
        row = machine.twin.parameter(item.name)
        if item.sd is None:
            stays = f"it stays {row.nominal:.4g} {row.unit} of the twin's example: write that of the data sheet"
            remarks.append(f"{row.name} ({row.meaning}): {item.remark}; {stays}")
            continue
        origin = item.remark or f"from {data.name}"
        remark = f"± {QUANTILE * item.sd:.2g} {row.unit}, {origin}{_as_right_as(machine, item)}"
        source = item.remark if item.is_taken else row.meaning
        drift = next((change for change in found.changes if change.name == item.name and change.is_drift), None)
        moves = f"; it moves from {drift.before:.4g} to {drift.after:.4g} {row.unit} in the record" if drift else ""
        depends = _as_right_as(machine, item)
        remarks.append(f"{row.name} = {interval_text(item.value, item.sd, row.unit)} ({source}){depends}{moves}")
        value = written_value(machine, row, item.value, _bounds(row, item.value))
        if item.only_with:
            value = value if isinstance(value, dict) else {"value": value}
            value["as_right_as"] = [other.name for other in item.only_with]
        lines[row.name] = NewLine(value, f"{row.meaning}: {remark}")
    for name, (low, high) in found.loads.items():
        row, largest = machine.twin.parameter(name), max(abs(low), abs(high))
        if largest > LOAD_SHARE * max(abs(row.low), abs(row.high)):
            ends = (0.0 if row.low >= 0.0 else -REACH * largest, 0.0 if row.high <= 0.0 else REACH * largest)
            remark = f"{row.meaning}: {low:.3g} to {high:.3g} {row.unit} in {data.name}"
            lines[name] = NewLine(written_value(machine, row, 0.5 * (low + high), ends), remark)
    return lines, remarks


def _as_right_as(machine: "LoadedMachine", item: "OwnValue") -> str:
    """Return with which held values a value is right or wrong, and by how much."""
    from otolith.health.schema import HeldDocument
    from otolith.health.text import only_as_right_as

    if not item.only_with:
        return ""
    units = machine.twin.units()
    held = {other.name: HeldDocument(value=other.value, unit=units[other.name]) for other in item.only_with}
    changes = [
        f"1 % more {other.name} is {abs(other.share):.2g} % {'more' if other.share > 0.0 else 'less'} {item.name}"
        for other in item.only_with
    ]
    return f"; {only_as_right_as(held)} ({', '.join(changes)})"


def written_value(
    machine: "LoadedMachine", row: "Parameter", value: float, bounds: tuple[float, float]
) -> dict[str, object] | str:
    """Return a found value as the file gets it; raise ConfigurationError if bounds that the file states exclude it.

    ``bounds`` are those of an estimate for which the file states none. A friction that stands for an unmeasured load
    too gets its limits: they hold for this value, not for that of a data sheet.
    """
    from otolith.machine import stands_for_load
    from otolith.machine_file import ParameterTable
    from otolith.twin.definition import Role
    from otolith_drivers.errors import ConfigurationError
    from otolith_drivers.units import Quantity

    stated, unit, text = machine.file.parameters.get(row.name, ParameterTable()), row.unit, f"{value:.5g} {row.unit}"
    if not (row.role is Role.ESTIMATED if stated.estimate is None else stated.estimate):
        return text
    ends = (stated.low, bounds[0]), (stated.high, bounds[1])
    low, high = (default if own is None else Quantity(unit)(own) for own, default in ends)
    if not low <= value <= high:
        fault = f"the data show {value:.4g} {unit}, outside the bounds {low:.4g} to {high:.4g} {unit} of the file"
        remedy = "nothing is written: correct low and high, or write the value of your machine"
        raise ConfigurationError(f"{machine.path}: parameters.{row.name}: {fault}: {remedy}")
    written: dict[str, object] = {"value": text, "estimate": True}
    written |= {"low": f"{low:.4g} {unit}", "high": f"{high:.4g} {unit}"}
    if stands_for_load(row.name, machine.twin, machine.complete) and (stated.watch, stated.act) == (None, None):
        written |= {"watch": list(row.watch), "act": list(row.act)}
    return written


def _bounds(row: "Parameter", value: float) -> tuple[float, float]:
    """Return bounds for an estimate of a healthy ``value``; below zero only where the twin allows it."""
    if row.low > 0.0:
        return value / REACH, REACH * value
    reach = REACH * max(abs(value), LOAD_SHARE * abs(row.nominal))
    return (0.0 if row.low == 0.0 else -reach), reach


def _with_noise_and_delays(
    machine: "LoadedMachine", identified: "IdentifiedNoise", delays: "IdentifiedDelays"
) -> "LoadedMachine":
    """Return the machine with noise levels and delays, which are written into its file."""
    from otolith.cli.commissioning.machine_lines import NewLine, with_delay, with_keys
    from otolith.cli.commissioning.noise import level_rows
    from otolith_drivers.errors import counted

    tables = {name: {key: NewLine(value, remark) for key, value, remark in rows}
              for name, rows in level_rows(machine, identified, is_written=True).items()}  # fmt: skip
    late = [item for item in delays.signals if item.is_late and item.sd is not None]

    def changed(text: str) -> str:
        for table, lines in tables.items():
            text = with_keys(text, table, lines)
        for item in late:
            remark = f"± {2e3 * (item.sd or 0.0):.2g} ms"
            text = with_delay(text, item.name, f"{1e3 * item.value:.4g} ms", remark)
        return text

    written = _written(machine, changed)
    done = [f"{counted(len(lines), 'level')} in [{table}]" for table, lines in tables.items() if lines]
    outcome = f"written: {', '.join(done)}" if done else "the data determine no level, so all stay as they are"
    echo(f"{machine.path}: {outcome}", err=True)
    for item in late:
        delay = f'{item.name} is {1e3 * item.value:.3g} ms late; written: delay = "{1e3 * item.value:.4g} ms"'
        echo(f"{machine.path}: {delay} under [signals]", err=True)
    return written


def _written(machine: "LoadedMachine", change: Callable[[str], str]) -> "LoadedMachine":
    """Return the machine after a change of its file; raise ConfigurationError if the file cannot be changed so."""
    from otolith.cli.commissioning.machine_lines import Unchangeable, write_machine_file
    from otolith.machine import load_machine
    from otolith_drivers.errors import ConfigurationError

    try:
        text = change(machine.path.read_bytes().decode())  # with its ends of lines
    except Unchangeable as error:
        remedy = "change it by hand: without --write the lines are printed"
        raise ConfigurationError(f"{machine.path}: {error}: {remedy}") from error
    write_machine_file(machine.path, text)
    return load_machine(machine.path, with_driver=False)


def _commission(
    machine: "LoadedMachine",
    store: "StateStore",
    data: "HealthyData",
    windows: int,
    how: Manner,
) -> None:
    from otolith.adaptation.fingerprints import fingerprint_of
    from otolith.adaptation.state import ComponentRecord
    from otolith.cli.commissioning.noise import delay_lines, identified_record, noise_lines
    from otolith.commissioning.identification import explains_no_window
    from otolith_drivers.errors import OtolithError

    record = identified_record(machine, data, windows)
    identified = record.noise_beside(machine) if record.offered else record.noise
    components = tuple(ComponentRecord.of(item) for item in record.offered)
    if how.write:
        machine = _with_noise_and_delays(machine, identified, record.delays)
        state, advice = _replayed(machine, data, how, components)
    else:
        is_useless = bool(components) or explains_no_window(machine.problem, record.noise, record.windows[0])
        first = None if is_useless else _replayed(machine, data, how)
        echo(*noise_lines(machine, identified), *delay_lines(machine, record.delays))
        if first is not None and first[0].adopted:  # the file's noise levels may have hidden a component
            state, advice = first
        else:
            levels = replace(machine, problem=identified.applied(machine.problem))
            state, advice = _replayed(levels, data, how, components)
        if record.offered:
            echo("# this process noise is right with the components below: if you approve them, put it into the file")
        elif state.adopted:
            echo("# this process noise contains the components below: keep that of the file if you approve them")
        else:
            echo("# put these tables into the machine file in place of its own, or let --write do it", err=True)
    _review(machine, store, state, components, decide=how.decide)
    try:
        keep_baseline(machine, store, state.health.histories, advice, fingerprint_of(machine.problem))
    except OtolithError as error:  # nothing that has limits, or a record that is too short
        echo(*str(error).split("\n"), err=True)


def _replayed(
    machine: "LoadedMachine", data: "HealthyData", how: Manner, components: "tuple[ComponentRecord, ...]" = ()
) -> "tuple[AdaptationState, dict[str, str]]":
    """Return the state after all windows of the data, and for each parameter what would determine it.

    The ``components`` are in the twin from the first window on.

    The number of findings and warnings are printed to standard error, with details each finding.
    """
    from otolith.adaptation.state import restore_components
    from otolith.cli.commissioning.noise import warn_once
    from otolith.runtime.replay import Replay
    from otolith_drivers.errors import counted

    advice: dict[str, str] = {}
    findings, with_findings, windows = 0, 0, 0
    with data.opened(machine) as recorded, progress_line("replay") as show:
        run = Replay(machine, recorded)
        run.state = restore_components(run.state, components)
        for report in run.reports():
            document = report.document
            show(f"window {document.window.index}, {run.progress:.0%} of the data")
            findings, windows = findings + len(document.findings), windows + 1
            with_findings += bool(document.findings)
            for finding in document.findings if how.details else ():
                echo(f"window {document.window.index}: {finding.text}", err=True)
            advice |= {name: item.advice for name, item in document.parameters.items() if item.advice}
        if findings and not how.details:
            of = f"in {counted(with_findings, 'window')} of {windows}"
            echo(f"{counted(findings, 'finding')} {of} of the replay: --details prints them", err=True)
        warn_once(machine, data, run.warnings())
        return run.state, advice


def _review(
    machine: "LoadedMachine",
    store: "StateStore",
    state: "AdaptationState",
    pooled: "tuple[ComponentRecord, ...]",
    *,
    decide: Decide,
) -> None:
    """Ask for a decision on each component, keep the approved ones, and print the estimated parameters.

    The values of ``pooled`` components are kept: all windows together are more precise than the filter after them.
    """
    from otolith.adaptation.state import component_records
    from otolith.health.text import interval_text

    precise = {key_of_record(record): record for record in pooled}
    records = tuple(precise.get(key_of_record(record), record) for record in component_records(state))
    approved, rejected = asked(machine, records, decide=decide)
    taken = store.taken()
    if store.components_path.exists():
        echo(f"what was learned before is kept as {store.set_aside()}", err=True)
    store.save_components(tuple(record for record in records if key_of_record(record) in approved), taken)
    _decide(store, approved, rejected)
    if not records:
        echo("no component was found: the twin explains the machine up to the noise", err=True)
    posterior = state.posterior.prior()
    for index, parameter in enumerate(state.problem.free):
        if not parameter.name.startswith("_"):
            mean, variance = float(posterior.mean[index]), float(posterior.covariance[index, index])
            echo(f"{parameter.name} = {interval_text(mean, variance**0.5, parameter.unit)}", err=True)


def asked(
    machine: "LoadedMachine", records: "Sequence[ComponentRecord]", *, decide: Decide
) -> tuple[set[str], set[str]]:
    """Return the keys of the components that belong to the healthy machine, and of those that do not."""
    approved, rejected = set[str](), set[str]()
    for record in records:
        echo(f"found {key_of_record(record)}: {equation_of(machine, record)}", err=True)
        if (answer := decide()) is None:
            echo(
                "it may also be a fault, or a signal that is late ('otolith noise'): nobody was asked, and it is",
                err=True,
            )
            echo(f"not approved: 'otolith commission {machine.path} DATA' asks", err=True)
        else:
            (approved if answer else rejected).add(key_of_record(record))
    return approved, rejected


def _decide(store: "StateStore", approved: set[str], rejected: set[str]) -> None:
    def changed(decisions: "OperatorDecisions") -> "OperatorDecisions":
        rest = (decisions.rejected | rejected) - approved
        return replace(decisions, approved=decisions.approved | approved, rejected=rest)

    store.operator.change(changed)


def ask_if_healthy() -> bool:
    """Ask a person whether a component belongs to the healthy machine; raise Abort without an answer."""
    try:
        return click.confirm(
            "does it belong to the healthy machine? (n rejects it: it is not searched for again)", err=True
        )
    except click.Abort:
        echo("", "no answer: nothing is kept; answer y or n, or give --yes", err=True)
        raise


def _commission_running(
    machine: "LoadedMachine",
    store: "StateStore",
    span: tuple[float, float],
    windows: int,
    how: Manner,
) -> None:
    """Commission by what a daemon has recorded and estimated from the first time of ``span`` to the second."""
    from otolith.adaptation.fingerprints import fingerprint_of
    from otolith.cli.commissioning.noise import HealthySpan, UnusableData, delay_lines, identified_record, noise_lines
    from otolith.storage.history import HistoryReader, history_path

    names = machine.file.machine
    reader, data = HistoryReader(history_path(names.site, names.name)), HealthySpan(machine, *span)
    zone = machine.plan.timezone
    echo(f"from {local_time(span[0], zone)} to {local_time(span[1], zone)}", err=True)
    _warn_of_events(reader, span, zone)
    before = machine
    try:
        if how.write:
            machine = _with_own_values(machine, data, windows)
        record = identified_record(machine, data, windows)
    except UnusableData as error:  # it records nothing, or not for so long
        what = "values, noise and delays" if machine is before else "the new values are in the file; noise and delays"
        echo(f"{what} are as they were: {error}", err=True)
    else:
        if how.write:
            machine = _with_noise_and_delays(machine, record.noise, record.delays)
        else:
            echo(*noise_lines(machine, record.noise), *delay_lines(machine, record.delays))
    if machine is not before:
        echo("a running daemon takes these lines over when it is started again", err=True)
    model = fingerprint_of(machine.problem)
    # The file may have been changed before, too: a daemon has the values that it had at its start.
    is_waiting = model != (store.model() or fingerprint_of(before.problem))
    has_new_values = is_waiting or machine.file.parameters != before.file.parameters
    _review_running(machine, store, how, has_new_values=has_new_values)
    if not has_new_values:
        histories, advice = _estimated(machine, reader, span)
    else:  # what was estimated with other values does not count
        state, advice = _replayed(machine, data, how)
        histories = dict(state.health.histories)
    keep_baseline(machine, store, histories, advice, model, labels=reader.labels())
    when = "when it is started again: it has other values now" if is_waiting else "with its next window"
    echo(f"a running daemon takes the baseline over {when}", err=True)
    if is_waiting or machine is not before:
        echo(f"next: {restart_command(machine.path)}", err=True)


def _review_running(machine: "LoadedMachine", store: "StateStore", how: Manner, *, has_new_values: bool) -> None:
    """Ask for a decision on each component that a daemon has found, unless the file has other values than it."""
    known = store.decisions()
    records = [row for row in store.components() if key_of_record(row) not in known.approved | known.rejected]
    if records and has_new_values:
        keys = ", ".join(map(key_of_record, records))
        echo(f"{keys}: found with the values before, so nothing is asked; the daemon that starts drops it", err=True)
    elif records:
        _decide(store, *asked(machine, records, decide=how.decide))


def _warn_of_events(reader: "HistoryReader", span: tuple[float, float], zone: str | None) -> None:
    """Name what the daemon announced in the time that is said to be healthy."""
    from otolith.health.limits import Level

    begin, end = span
    parts = {
        f"{row.part or 'machine'} {row.state} at {local_time(row.entered, zone)}"
        for row in reader.states(begin)
        if row.state in (Level.WATCH, Level.ACT) and begin <= row.entered <= end
    }
    for text in sorted(parts):
        echo(f"! {text}: was the machine healthy then? 'otolith history --events' shows it", err=True)


def _estimated(
    machine: "LoadedMachine", reader: "HistoryReader", span: tuple[float, float]
) -> "tuple[dict[str, History], dict[str, str]]":
    """Return the estimates of the daemon in a span (Unix times), and what would determine the others."""
    from otolith.health.events import history_point
    from otolith.health.prognosis import with_point
    from otolith.health.schema import ReportDocument

    histories: dict[str, History] = {}
    advice: dict[str, str] = {}
    after = 0
    while texts := reader.messages("report", REPORTS_AT_ONCE, after, *span):
        for text in texts:
            document = ReportDocument.from_json(text)
            after = document.sequence or after
            advice |= {name: item.advice for name, item in document.parameters.items() if item.advice}
            for name in document.parameters:
                if (point := history_point(machine.plan, document, name)) is not None:
                    histories[name] = with_point(histories.get(name, ()), *point)
    return histories, advice
