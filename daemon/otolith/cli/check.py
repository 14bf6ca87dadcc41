"""``otolith check``: what the daemon would do with a machine file, and whether its signals come."""

import math
import time
from collections import Counter
from collections.abc import Callable, Container, Sequence
from pathlib import Path

from otolith.machine import LoadedMachine, load_machine, recording_folder
from otolith.publishing.zenoh_session import prefix
from otolith_drivers.base import Sample
from otolith_drivers.user_dirs import check_writable

LISTEN = 1.0  # s, or as long as so many samples take:
ENOUGH = 60
PATIENCE, PAUSE = 4.0, 0.1  # s for what does not come, until the driver knows why
PROBED = ("can", "modbus")


def check_machine(path: Path, say: Callable[[str], None], *, with_device: bool) -> bool:
    """Say, line by line, what the daemon would do, and what came from the bus within a second.

    Returns:
        Whether every signal came; also true if nobody was to listen.

    Raises:
        OtolithError: whatever would keep the daemon from starting.
    """
    plan = load_machine(path)
    for line in describe(plan):
        say(line)
    if plan.file.recording.enabled:
        check_writable(recording_folder(plan))
    if not with_device:
        return True
    counts, lines = _listen(plan)
    for line in lines:
        say(line)
    return set(plan.twin.signals) <= set(counts)


def describe(plan: LoadedMachine) -> list[str]:
    """What the daemon would do, a line per fact; what the file leaves to the twin is marked."""
    file, problem, twin = plan.file, plan.problem, plan.twin
    lines = [
        f"machine {file.machine.name} at {file.machine.site}, twin {twin.name}: {twin.title}",
        *(f"  {name} = {text}" for name, text, _ in twin.definitions),
        *(f"  {left} = {right}" for left, right in twin.equations),
        *plan.driver.describe(),
        f"windows of {file.window.length:g} s, {plan.records} records",
    ]
    for name, value in problem.known:
        entry = twin.parameter(name)
        lines.append(f"known: {name} = {value:g} {entry.unit} ({entry.meaning}){_left_open(name, file.parameters)}")
    for entry in problem.free:
        span = f"from {entry.low:g} to {entry.high:g} {entry.unit}, starting at {entry.nominal:g} {entry.unit}"
        lines.append(f"estimated: {entry.name} {span} ({entry.meaning}){_left_open(entry.name, file.parameters)}")
    for output, noise in zip(twin.outputs, problem.noise, strict=True):
        lines.append(f"noise of {output.name}: {noise:g} {output.unit}{_left_open(output.name, file.noise)}")
    for driving, noise in zip(twin.inputs, problem.input_noise, strict=True):
        lines += [f"noise of {driving.name}: {noise:g} {driving.unit}"] if noise else []
    for state, noise in zip(twin.states, problem.process_noise, strict=True):
        lines += [f"process noise of {state.name}: {noise:g} {state.unit} per square root of a second"] if noise else []
    endpoints = ", ".join(file.zenoh.listen) or "no endpoint"
    lines.append(f"reports on {endpoints}, keys {prefix(file.machine.site, file.machine.name)}/...")
    lines.append(f"recordings into {recording_folder(plan)}" if file.recording.enabled else "no recordings")
    return lines


def _left_open(name: str, said: Container[str]) -> str:
    return "" if name in said else " [not in the file: the twin's own value]"


def _listen(plan: LoadedMachine) -> tuple[Counter[str], list[str]]:
    """How many samples of each signal came, and what there is to say of it."""
    counts: Counter[str] = Counter()
    latest: dict[str, float] = {}

    def deliver(samples: Sequence[Sample]) -> None:
        counts.update(sample.signal for sample in samples)
        latest.update((sample.signal, sample.value) for sample in samples if math.isfinite(sample.value))

    driver, signals, period = plan.driver, plan.twin.signals, plan.file.window.sample_period
    kind = plan.file.driver.get("type")
    begun = time.monotonic()
    driver.open(deliver)
    time.sleep(max(LISTEN, ENOUGH * period))
    while time.monotonic() < begun + PATIENCE and len(counts) < len(signals) and not driver.link().warnings:
        time.sleep(PAUSE)
    link, listened = driver.link(), time.monotonic() - begun
    driver.close()
    lines = [
        f"heard {signal}: {counts[signal]} samples in {listened:.1f} s"
        + _verdict(
            counts[signal], listened / period, latest.get(signal), plan.twin.unit_of(signal), any_came=bool(counts)
        )
        for signal in signals
    ]
    lines += [f"plan: {link.plan}"] if link.plan else []
    lines += link.warnings
    lines += [] if link.up else [f"no connection: {link.reason}"]
    if kind in PROBED and len(latest) < len(signals):
        lines.append(f"what is there is shown by 'otolith probe {kind}'")
    return counts, lines


def _verdict(count: int, wanted: float, latest: float | None, unit: str, *, any_came: bool) -> str:
    if not count:
        return ": others come, so is its place in [signals] right?" if any_came else ": is the machine on?"
    few = "" if count >= 0.5 * wanted else ", too few"
    return few + (", none of them a reading" if latest is None else f", now {latest:.4g} {unit}")
