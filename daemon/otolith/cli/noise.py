"""``otolith noise``: levels of noise, learned from recorded data of a healthy machine, ready for its machine file."""

import json
import signal
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from otolith.acquisition.window import Window
    from otolith.commissioning.identification import IdentifiedNoise, NoiseLevel
    from otolith.machine import LoadedMachine


Entry = TypeVar("Entry")
FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("file", type=FILE)
@click.argument("data", type=FILE)
@click.option(
    "--windows",
    type=click.IntRange(1, 1000),
    default=30,
    show_default=True,
    help="Learn from so many at most, spread over the data.",
)
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def noise(file: Path, data: Path, windows: int, as_json: bool) -> None:
    """Learn the noise of the machine in FILE from the table DATA, and print it as lines for FILE.

    DATA was recorded from the machine in good health and in motion, and is written as for 'otolith replay'. What is
    printed replaces the tables [noise] and [process_noise] of FILE.

    \b
    Examples:
      otolith noise my-machine.toml monday.csv
      otolith noise my-machine.toml monday.csv --windows 100 --json
    """
    from otolith.machine import load_machine

    signal.signal(signal.SIGINT, signal.default_int_handler)  # so that the line of progress is put away
    plan = load_machine(file, with_driver=False)
    found = learned_noise(plan, data, windows)
    if as_json:
        click.echo(json.dumps(_document(plan, found), indent=2, ensure_ascii=False))
    else:
        for line in lines_of(plan, found):
            click.echo(line)


def learned_noise(plan: "LoadedMachine", data: Path, windows: int) -> "IdentifiedNoise":
    """From at most so many windows of the table.

    Raises:
        ConfigurationError: it has none that can be used.
    """
    from otolith.commissioning.identification import identify_noise
    from otolith_drivers.errors import ConfigurationError

    with _progress() as status:
        found = identify_noise(plan.problem, _windows(plan, data, windows), progress=status.update)
    if plan.problem.open_loop:
        click.echo(f"{plan.path}: as long as open_loop is true, process noise will not be used", err=True)
    if not found.windows:
        raise ConfigurationError(f"{data}: {'; '.join(found.remarks)}")
    return found


def _progress() -> Any:
    """On standard error, if somebody sees it."""
    from rich.console import Console

    console = Console(stderr=True)
    console.quiet = not console.is_terminal
    return console.status("reading")


def _windows(plan: "LoadedMachine", data: Path, most: int) -> list["Window"]:
    """At most so many windows of the table that can be used, spread over it.

    Raises:
        ConfigurationError: there is none; with the reason of the last one, if it has one.
    """
    from otolith.runtime.replay import Replay, open_recorded
    from otolith_drivers.errors import ConfigurationError

    reasons: tuple[str, ...] = ()

    def good(windows: Iterable["Window"]) -> Iterator["Window"]:
        nonlocal reasons
        for window in windows:
            if window.quality.reasons:
                reasons = window.quality.reasons
            else:
                yield window

    with open_recorded(plan, data) as recorded:
        run = Replay(plan, recorded)
        found = _spread(good(run.windows()), most)
        warnings = run.warnings()
    for line in warnings:
        click.echo(f"{data}: {line}", err=True)
    if not found:
        length = f"no window of {plan.file.window.length:g} s can be used"
        raise ConfigurationError(f"{data}: {length}: {'; '.join(reasons) or 'the data is too short'}")
    return found


def _spread(entries: Iterable[Entry], most: int) -> list[Entry]:
    """Evenly, without holding more than twice as many at any time, however long the table is."""
    kept: list[Entry] = []
    stride = 1
    for index, entry in enumerate(entries):
        if index % stride == 0:
            kept.append(entry)
        if len(kept) > 2 * most:
            kept, stride = kept[::2], 2 * stride
    count = min(most, len(kept))
    return [kept[round(index * (len(kept) - 1) / max(count - 1, 1))] for index in range(count)]


def lines_of(plan: "LoadedMachine", found: "IdentifiedNoise") -> Iterator[str]:
    """Both tables, with what there is to know of them as comments."""
    twin, problem = plan.twin, plan.problem
    yield "[noise]"
    rows = [_row(level, twin.unit_of(level.name)) for level in found.outputs]
    given = zip(twin.inputs, problem.input_noise, strict=True)
    rows += [(f'{entry.name} = "{level:.3g} {entry.unit}"', "as it was") for entry, level in given if level]
    yield from _aligned(rows)
    yield ""
    yield "[process_noise]"
    yield from _aligned([_row(level, f"{twin.unit_of(level.name)}/s^0.5") for level in found.states])
    yield ""
    consistency = found.consistency
    yield f"# learned from {found.windows} windows of {plan.file.window.length:g} s"
    if consistency.before is not None and consistency.after is not None:
        after = f", now {consistency.after:.3g}" if consistency.after != consistency.before else ""
        factor = f"; process noise times {consistency.factor:.3g}" if (consistency.factor or 1.0) != 1.0 else ""
        yield f"# chi-square between windows, per degree of freedom: {consistency.before:.3g}{after}{factor}"
    yield f"# {consistency.remark}"
    yield from (f"# {remark}" for remark in found.remarks)


def _row(level: "NoiseLevel", unit: str) -> tuple[str, str]:
    exactness = f"± {level.sd / level.value:.1%}" if level.sd is not None and level.value else ""
    return f'{level.name} = "{level.value:.3g} {unit}"', "; ".join(filter(None, [exactness, level.remark]))


def _aligned(rows: list[tuple[str, str]]) -> list[str]:
    width = max(len(line) for line, _ in rows)
    return [f"{line:{width}}  # {comment}" if comment else line for line, comment in rows]


def _document(plan: "LoadedMachine", found: "IdentifiedNoise") -> dict[str, Any]:
    from dataclasses import asdict

    units = plan.twin.units()
    document = asdict(found)
    for entry in document["outputs"]:
        entry["unit"] = units[entry["name"]]
    for entry in document["states"]:
        entry["unit"] = f"({units[entry['name']]})/s^0.5"
    return document
