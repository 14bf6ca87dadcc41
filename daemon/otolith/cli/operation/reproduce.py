"""``otolith reproduce``: the reports around an event, computed again from its evidence."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.common import FILE, local_time, progress_line

if TYPE_CHECKING:
    from otolith.storage.evidence import Bundle

# What values raise that have the right types, but that no state of the core has.
FORGED = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)


@click.command()
@click.argument("bundle", type=FILE)
@click.option("--json", "as_json", is_flag=True, help="Print each report as a line of JSON.")
def reproduce(bundle: Path, as_json: bool) -> int:
    """Compute the reports around an event again, from its evidence.

    BUNDLE is a file in the folder 'evidence' of the daemon's state directory. It
    has the last windows up to the one that raised, changed or cleared the event,
    and the state before them. Each report must be the same to the last bit;
    otherwise the first difference is shown, and the exit code is 1.

    \b
    Examples:
      otolith reproduce hall.press-3-000007-20260131T101112.zip
      otolith reproduce hall.press-3-000007-20260131T101112.zip --json
    """
    from otolith.health.text import event_text
    from otolith.storage.evidence import printable, read_bundle, versions
    from otolith_drivers.errors import counted

    def echo(line: str) -> None:
        click.echo(printable(line), err=as_json)

    read = read_bundle(bundle)
    state, count, span = read.state, len(read.windows), (read.windows[0].window.start, read.windows[-1].window.end)
    echo(f"{state.machine} at {state.site}, {counted(count, 'window')} from {' to '.join(map(local_time, span))}")
    for event in read.events:
        echo(f"{event.change}: {event_text(event, local_time)}")
    echo(f"seed {state.problem.seed}, " + ", ".join(f"{name} {number}" for name, number in read.versions.items()))
    with progress_line("reproducing") as show:
        difference = _first_difference(read, show, click.echo if as_json else lambda _: None)
    others = [f"{name} {here}" for name, here in versions().items() if read.versions.get(name) != here]
    if others:
        echo(f"other versions here, on which the last bits may depend: {', '.join(others)}")
    echo(f"not the same: {difference}" if difference else f"the same to the last bit: {counted(count, 'report')}")
    return 1 if difference else 0


def _first_difference(bundle: "Bundle", show: Callable[[str], None], put: Callable[[str], None]) -> str:
    """Compute the reports of a bundle, ``put`` each, and return where the first one differs; empty if none does."""
    from otolith import kernel_cache
    from otolith.adaptation.adapt import adapt

    state = bundle.state
    with kernel_cache.observed(lambda step: show(f"compiling {step.kernel}")):
        for item in bundle.windows:
            show(place := f"window {item.window.index}")
            try:
                state, report = adapt(item.state or state, item.window)
                put(text := report.document.to_json())
                if text != item.report:
                    return f"{place}: {_difference(json.loads(item.report), json.loads(text))}"
            except FORGED as error:
                return f"{place}: {type(error).__name__}: {error}"
    return ""


def _difference(kept: Any, computed: Any, place: str = "report") -> str:
    """Return the place of the first difference of two documents, and its values."""
    if isinstance(kept, list) and isinstance(computed, list):
        kept, computed = dict(enumerate(kept)), dict(enumerate(computed))
    if isinstance(kept, dict) and isinstance(computed, dict):
        for key in (*kept, *computed):
            first, second = kept.get(key), computed.get(key)
            if json.dumps(first) != json.dumps(second):  # 0.0 and -0.0 are equal, but not the same
                return _difference(first, second, f"{place}.{key}")
    return f"{place}: {json.dumps(kept):.100} in the bundle, {json.dumps(computed):.100} computed"
