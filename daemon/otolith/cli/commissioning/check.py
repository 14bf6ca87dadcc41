"""``otolith check``: what the daemon would do with a machine file, and whether its signals come."""

import math
import time
from collections import Counter
from collections.abc import Callable, Container, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from otolith.cli.common import progress_line
from otolith.cli.terminal import echo, echo_json
from otolith.fmu.description import read_fmu
from otolith.fmu.reference import FmuReference
from otolith.fmu_twin import TUNABLE
from otolith.health.text import only_as_right_as
from otolith.machine import LoadedMachine, load_machine
from otolith.outlet_tables import MachineOutlets
from otolith.publishing.zenoh_config import Access, listening
from otolith.publishing.zenoh_session import prefix
from otolith.runtime.preview import preview_lines, preview_recording
from otolith.twin.definition import Definition, Parameter, Role
from otolith.twin.identifiability import structural_identifiability
from otolith_drivers.base import Link, Sample
from otolith_drivers.config_files import read
from otolith_drivers.errors import some_names
from otolith_drivers.user_dirs import check_writable

# Engineering choices, guarded by tests/cli/test_check.py.
LISTEN = 1.0  # s; the shortest time to listen,
MIN_PERIODS = 60  # or so many sample periods if that is longer: a drive polled at 1 Hz needs a minute
PATIENCE = 4.0  # s to wait for missing signals until the driver gives the cause, such as a refused connection
MIN_SHARE = 0.5  # of the samples expected at the sample period; below it the expected number is printed
PAUSE = 0.1  # s between two looks at the driver
PROBED = ("can", "modbus")  # drivers that have an 'otolith probe'
NO_LIMITS = "none, so no change of it is an event: write {} = {{ watch = {} }} under [parameters]"
NONE_HAS_LIMITS = "no limits of {}, so no change of them is an event: write for example {} = {{ watch = {} }}"
FOR_REPLAY_ONLY = "no [driver] and no [signals]: for 'otolith replay' only"


def check_machine(path: Path, echo: Callable[[str], None], *, with_device: bool) -> bool:
    """Print line by line what the daemon would do, and what came from the bus within a second or so.

    Returns:
        Whether every signal came; also true without a device.

    Raises:
        OtolithError: anything that would keep the daemon from starting.
    """
    machine = load_machine(path, for_replay=not with_device)
    machine.try_fmu()
    for line in describe(machine):
        echo(line)
    for name, place in _outlets(machine).items():
        echo(f"outlet {name}: {place}")
    if machine.file.recording.enabled:
        check_writable(machine.recording_folder)
    if not with_device:
        return True
    counts, lines = _listen(machine)
    for line in lines:
        echo(line)
    return set(machine.twin.signals) <= set(counts)


def check_data(path: Path, data: Sequence[Path], *, as_json: bool) -> bool:
    """Print what the daemon would do with ``data``, and what the data offer: line by line, or the latter as JSON.

    Returns:
        Whether parameters can be estimated from any window.

    Raises:
        OtolithError: a file that cannot be used.
    """
    machine = load_machine(path, with_driver=False)
    machine.try_fmu()
    with progress_line("reading", enabled=not as_json) as show:
        preview = preview_recording(machine, data, progress=show)
    if as_json:
        echo_json(preview.document(), indent=2)
        return preview.is_usable
    echo(*describe(machine, preview.sources), *preview_lines(preview, machine.plan.timezone))
    if not preview.is_usable:
        windows = "no window can be used" if preview.windows.count else "the data are too short for a window"
        echo(f"{windows} as {path.name} configures them")
    return preview.is_usable


def describe(machine: LoadedMachine, sources: Sequence[str] = (FOR_REPLAY_ONLY,)) -> list[str]:
    """What the daemon would do, a line per fact; a value that the file leaves to the twin is marked.

    ``sources`` has the lines of a machine that was loaded without its driver.
    """
    file, problem, twin = machine.file, machine.problem, machine.twin
    lines = [
        f"machine {file.machine.name} at {file.machine.site}, twin {twin.name}: {twin.title}",
        *(equations(twin) if twin.fmu is None else of_fmu(machine)),
        *(machine.driver.describe() if machine.built_driver else sources),
        *without_sensors(machine),
        *_delays(machine),
        f"windows of {file.window.length:g} s, {machine.records} records",
    ]
    known = dict(problem.known)
    for name, value in known.items():
        row = twin.parameter(name)
        lines.append(f"known: {name} = {value:g} {row.unit} ({row.meaning}){_origin(name, file.parameters)}")
        lines += _held(machine, name)
    for free in problem.free:
        bounds = f"from {free.low:g} to {free.high:g} {free.unit}, starting at {free.nominal:g} {free.unit}"
        lines.append(f"estimated: {free.name} {bounds} ({free.meaning}){_origin(free.name, file.parameters)}")
        lines += _held(machine, free.name)
        limits = machine.plan.parameters[free.name].limits_text
        lines.append(f"limits of {free.name}: {limits or NO_LIMITS.format(free.name, _example_limits(free))}")
    for name, site in machine.plan.sites.items():
        lines += [f"limits of components at {name}: {site.limits_text}"] if site.limits else []
    for output, noise in zip(twin.outputs, problem.noise, strict=True):
        lines.append(f"noise of {output.name}: {noise:g} {output.unit}{_origin(output.name, file.noise)}")
    for driving, noise in zip(twin.inputs, problem.input_noise, strict=True):
        lines += [f"noise of {driving.name}: {noise:g} {driving.unit}"] if noise else []
    for state, noise in zip(twin.states, problem.process_noise, strict=True):
        lines += [f"process noise of {state.name}: {noise:g} {state.unit} per square root of a second"] if noise else []
    swarm = file.swarm
    lines.append(
        f"first window: global search by {swarm.algorithm}, population of {swarm.size}, at most "
        f"{swarm.generations} generations, seed {swarm.seed}"
    )
    endpoints = listening(file.zenoh.listen, f"{file.machine.site}.{file.machine.name}")
    _, validity = Access(file.zenoh, machine.path_of("zenoh")).settings(
        [prefix(file.machine.site, file.machine.name)], endpoints
    )
    lines += [f"! {warning}"] if (warning := validity.warning(datetime.now(UTC))) else []
    lines.append(
        f"reports on {', '.join(endpoints) or 'no endpoint'}, keys {prefix(file.machine.site, file.machine.name)}/..."
    )
    lines.append(f"recordings into {machine.recording_folder}" if file.recording.enabled else "no recordings")
    return lines


def _held(machine: LoadedMachine, name: str) -> list[str]:
    """Return the line that says with which held values a parameter is right or wrong; none without any."""
    held = only_as_right_as(machine.plan.held_with(name))
    return [f"{name} is {held}"] if held else []


def equations(twin: Definition) -> list[str]:
    """Return the lines of definitions and equations."""
    rows = [(name, text) for name, text, _ in twin.definitions] + [*twin.equations]
    return [f"  {left} = {right}" for left, right in rows]


def _of_state(fmu: FmuReference) -> str:
    """Return how the FMU is brought to the states from which a value is wanted."""
    if not fmu.is_stepped:
        return "its state is set for each value, so nothing of it is saved"
    if fmu.can_restore:
        return "before each step its state is restored and start values are set"
    begins = "it is reset before each step, which begins from a fit of its start values"
    return f"its state cannot be restored: {begins}; an export with canGetAndSetFMUstate may be faster"


def of_fmu(machine: LoadedMachine) -> list[str]:
    """Return what the FMU of a twin offers; it is tried before.

    Raises:
        ConfigurationError: the FMU cannot be used.
    """
    fmu, trial, twin = machine.twin.fmu, machine.try_fmu(), machine.complete
    if fmu is None or trial is None:
        return []
    offered = read_fmu(Path(fmu.path))
    kind = "model exchange" if fmu.is_model else "co-simulation, whose derivatives are read at start values"
    if fmu.is_stepped:
        steps = f"whole multiples of {fmu.own_step:g} s" if fmu.own_step else "any length"
        kind = f"co-simulation, which makes steps of {steps}"
    slopes = "its own directional derivatives by states and inputs" if fmu.has_slopes else "central differences"
    took = f"{1e6 * trial.seconds:.2g} µs for each value"
    lines = [
        f"  equations in {Path(fmu.path).name}: FMI {fmu.version}.0, {kind}; {took}",
        f"  sensitivities by {slopes}; {_of_state(fmu)}",
    ]
    units = twin.units()
    for name, rows in (("states", twin.states), ("inputs", twin.inputs), ("outputs", twin.outputs)):
        lines.append(f"  {name}: {', '.join(f'{row.name} ({units[row.name]})' for row in rows)}")
    settable = (TUNABLE,) if fmu.is_model else (TUNABLE, "fixed")
    used = {row.name for row in fmu.parameters}
    unused = [row.name for row in offered.of("parameter", *settable) if row.name not in used]
    lines += [f"  not used, so they keep their values: {some_names(unused)}"] if unused else []
    fixed = [row.name for row in offered.of("parameter", "fixed")] if fmu.is_model else []
    lines += [f"  fixed, so they cannot be estimated: {some_names(fixed)}"] if fixed else []
    for rate, state in trial.integrals:
        if (rate, state) not in fmu.integrals:
            position, speed = twin.states[rate].name, twin.states[state].name
            lines.append(f'  ! {position} integrates {speed}: write derivative = "{speed}" there in [twin.variables]')
    return lines


def _outlets(machine: LoadedMachine) -> dict[str, str]:
    """Return where reports are passed on to, by the name of the outlet.

    Raises:
        ConfigurationError: a file that an outlet names cannot be used.
        ServiceError: a library is missing.
    """
    identity, table, file = machine.file.machine, machine.file.outlets, machine.path_of("outlets")
    if not table.names:
        return {}
    from otolith.site.outlets.process import places

    return places(MachineOutlets(identity.site, identity.name, file, table), read(file))


def lines_without_limits(machine: LoadedMachine) -> list[str]:
    """Return a line that names the estimated parameters without limits, and says what to write; none if all have."""
    rows = [row for row in machine.problem.free if not machine.plan.parameters[row.name].has_limits]
    if len(rows) < 2:
        return [f"limits of {row.name}: {NO_LIMITS.format(row.name, _example_limits(row))}" for row in rows]
    names = ", ".join(row.name for row in rows)
    return [f"{NONE_HAS_LIMITS.format(names, rows[0].name, _example_limits(rows[0]))} under [parameters]"]


def _example_limits(free: Parameter) -> str:
    """Limits that a person may write: percentages, which a nominal value of zero has not."""
    if free.nominal:
        return '["-10 %", "+10 %"]'
    return f'["{0.5 * free.low:.3g} {free.unit}", "{0.5 * free.high:.3g} {free.unit}"]'


def without_sensors(machine: LoadedMachine) -> list[str]:
    """What is assumed of inputs that no sensor measures, and what can therefore be estimated no longer, or less."""
    if not machine.unmeasured:
        return []
    names = ", ".join(item.name for item in machine.unmeasured)
    free, known = dict.fromkeys(row.name for row in machine.problem.free), dict(machine.problem.known)
    lines = [f"not measured: {item.description}" for item in machine.unmeasured]
    configured, complete = (_configured(machine, twin) for twin in (machine.twin, machine.complete))
    rows = {row.name: row for row in structural_identifiability(configured)}
    lines += [
        f"! {name} cannot be estimated: {rows[name].reason}: give one of them a value, or measure {names}"
        for name in free
        if not rows[name].identifiable
    ]
    constant = {row.name: row for row in structural_identifiability(configured, settled=True)}
    lines += [
        f"while inputs are constant, {name} cannot be estimated: {constant[name].reason}"
        for name in free
        if rows[name].identifiable and not constant[name].identifiable
    ]
    before, after = (
        {row.name for row in structural_identifiability(_all_estimated(twin)) if row.identifiable}
        for twin in (complete, configured)
    )
    own = {row.name for row in complete.parameters}
    lost = [
        row.name
        for row in configured.parameters
        if row.name not in after and (row.name in before or row.name not in own)
    ]
    given, resting = (
        [name for name in lost if name in known],
        [name for name in lost if name in free and rows[name].identifiable],
    )
    if given and resting:
        ratios = f"without {names} the signals have only their ratios"
        lines.append(f"{', '.join(resting)}: as right as the given {', '.join(given)}; {ratios}")
    return lines


def _configured(machine: LoadedMachine, twin: Definition) -> Definition:
    """The twin with roles and bounds of the machine file."""
    free, known = {row.name: row for row in machine.problem.free}, dict(machine.problem.known)
    return replace(
        twin,
        parameters=tuple(
            replace(free[row.name], role=Role.ESTIMATED)
            if row.name in free
            else replace(row, nominal=known[row.name], role=Role.INSTRUMENTED)
            for row in twin.parameters
        ),
    )


def _all_estimated(twin: Definition) -> Definition:
    return replace(twin, parameters=tuple(replace(row, role=Role.ESTIMATED) for row in twin.parameters))


def _delays(machine: LoadedMachine) -> list[str]:
    """The declared delays; sources without any are unlikely to be equally late."""
    declared = {name: table.delay for name, table in machine.signal_tables.items() if table.delay}
    if not declared and len(machine.file.drivers) > 1:
        return ["no signal has a delay: 'otolith noise' identifies by how much one source is later than another"]
    return [f"delay of {name}: {1e3 * delay:g} ms" for name, delay in declared.items()]


def _origin(name: str, in_file: Container[str]) -> str:
    return "" if name in in_file else " [not in the file: the twin's own value]"


def _listen(machine: LoadedMachine) -> tuple[Counter[str], list[str]]:
    """The number of samples of each signal that came, and the lines to print."""
    counts: Counter[str] = Counter()
    latest: dict[str, float] = {}

    def deliver(samples: Sequence[Sample]) -> None:
        counts.update(sample.signal for sample in samples)
        latest.update((sample.signal, sample.value) for sample in samples if math.isfinite(sample.value))

    driver, signals, period = machine.driver, machine.twin.signals, machine.file.window.sample_period
    begun = time.monotonic()
    driver.open(deliver)
    time.sleep(max(LISTEN, MIN_PERIODS * period))
    while time.monotonic() < begun + PATIENCE and len(counts) < len(signals) and not _causes(driver.link()):
        time.sleep(PAUSE)
    link, seconds = driver.link(), time.monotonic() - begun
    driver.close()
    neighbours = {signal: state.signals for state in link.sources for signal in state.signals}
    lines = []
    for signal in signals:
        any_came = any(counts[other] for other in neighbours.get(signal, signals))
        remark = _remark(counts[signal], seconds / period, any_came=any_came)
        value = f", now {latest[signal]:.4g} {machine.twin.unit_of(signal)}" if signal in latest else ""
        none_usable = ", none of them a number" if counts[signal] and not value else ""
        lines.append(f"received {signal}: {counts[signal]} samples in {seconds:.1f} s{remark}{value}{none_usable}")
    lines += [f"polling: {link.plan}"] if link.plan else []
    lines += link.warnings
    lines += [] if link.up else [f"no connection: {link.reason}"]
    for table in machine.file.drivers:
        kind = table.get("type")
        of_source = next((state.signals for state in link.sources if state.name == table.get("name")), signals)
        if kind in PROBED and not set(of_source) <= set(latest):
            lines.append(f"'otolith probe {kind}' shows what is on the bus")
    return counts, list(dict.fromkeys(lines))


def _causes(link: Link) -> list[str]:
    """The warnings of all sources, without those that are not connected yet."""
    links = [state.link for state in link.sources] or [link]
    return [warning for each in links for warning in each.warnings]


def _remark(count: int, expected: float, *, any_came: bool) -> str:
    if count >= MIN_SHARE * expected:
        return ""
    if count:
        return f"; {expected:.0f} were expected: check the cycle time in the device"
    if any_came:
        return ": other signals come, so check its entry in [signals]"
    return ": is the machine on?"
