"""What the studies found, as people read it."""

from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from otolith.health.report import Status
from otolith.paper.rows import PEAK, SENSORS
from otolith.paper.score import verdict
from otolith.paper.studies import BLUNT, LENGTH, Edge, Kind, Limit, Study


def pages(found: Sequence[Study | Limit]) -> Iterator[RenderableType]:
    """All tables, in the order in which they are read."""
    studies = [entry for entry in found if isinstance(entry, Study)]
    ideal = [entry for entry in studies if entry.job.kind is Kind.IDEAL]
    noisy = [entry for entry in studies if entry.job.kind is Kind.NOISY]
    yield _against_the_paper(ideal)
    yield _circumstances(ideal, "ideal sensors")
    yield _windows(ideal, "ideal sensors")
    if noisy:
        for machine in dict.fromkeys(entry.job.row.machine for entry in noisy):
            yield Text(f"noisy sensors of {machine}: {_sensors(machine)}")
        yield _circumstances(noisy, "noisy sensors")
        yield _windows(noisy, "noisy sensors")
    for entry in found:
        if isinstance(entry, Limit):
            yield Text(limit_in_words(entry))
    yield _judgement(ideal)


def _against_the_paper(studies: Sequence[Study]) -> Table:
    title = f"relative error of the published value, windows of {LENGTH:g} s, ideal sensors, % (target)"
    table = _table(title, "scenario", "parameter", "median", "99 % below", "largest", "", "paper")
    for entry in studies:
        row, error = entry.job.row, entry.score.published
        met = verdict(row, entry.score)
        table.add_row(
            row.name,
            row.parameter,
            _percent(error.median),
            f"{_percent(error.p99)} ({_percent(row.target)})",
            f"{_percent(error.maximum)} ({_percent(PEAK * row.target)})",
            Text("met", style="green") if met else Text("not met", style="red"),
            _percent(row.paper),
        )
    table.caption = "paper: what it says that its error stays below, but for peaks"
    return table


def _circumstances(studies: Sequence[Study], sensors: str) -> Table:
    title = f"how it came about, windows of {LENGTH:g} s, {sensors}"
    table = _table(
        title,
        "scenario",
        "first\nexcited",
        "first\nestimated",
        "worst",
        "missing",
        Status.HELD,
        Status.INVALID,
        "in 95 %",
        "RMSE",
    )
    for entry in studies:
        found = entry.score
        units = dict(zip(entry.curves.outputs, entry.curves.units, strict=True))
        table.add_row(
            entry.job.row.name,
            str(found.begun) if found.begun < found.windows else "never",
            "never" if found.first is None else str(found.first),
            "" if found.worst is None else str(found.worst),
            str(found.published.missing),
            str(found.statuses[Status.HELD]),
            str(found.statuses[Status.INVALID]),
            "" if found.coverage is None else f"{found.coverage:.1%}",
            "\n".join(f"{name} {value:.2g} {units[name]}" for name, value in found.rmse.items()),
        )
    table.caption = "first and worst are numbers of windows, all others counts from the first excited one on"
    return table


def _windows(studies: Sequence[Study], sensors: str) -> Table:
    title = f"error by length of the window, {sensors}, %"
    table = _table(title, "scenario", "window", "", "median", "99 % below", "largest", "without")
    for entry in studies:
        for found in entry.scores:
            for number, (name, error) in enumerate((("alone", found.raw), ("published", found.published))):
                table.add_row(
                    entry.job.row.name if found is entry.scores[0] and not number else "",
                    "" if number else f"{found.length:g} s",
                    name,
                    _percent(error.median),
                    _percent(error.p99),
                    _percent(error.maximum),
                    str(error.missing or ""),
                    end_section=found is entry.scores[-1] and number == 1,
                )
    table.caption = "alone: what each window says by itself, as the paper reports it; published: with those before it"
    return table


def limit_in_words(found: Limit) -> str:
    """At which noise the parameter is lost."""
    sensor, machine = found.sensor, found.job.row.machine
    others = ", ".join(f"{entry.signal} {entry.noise:g} {entry.unit}" for entry in SENSORS[machine] if entry != sensor)
    said = (
        f"every window alone {_edge(found.alone, sensor.unit)}",
        f"all together {_edge(found.together, sensor.unit)}",
        f"all together with {BLUNT:g} times that on the others {_edge(found.unaided, sensor.unit)}",
    )
    lost = f"{found.job.row.parameter} is lost (95 % interval beyond 10 %) in noise of {sensor.signal}"
    return f"{machine}: {lost}, beside noise of {others}, to {'; to '.join(said)}"


def _edge(edge: Edge, unit: str) -> str:
    if edge.lost is None:
        return f"not even at {edge.kept:.3g} {unit}"
    return f"{'at' if edge.kept is not None else 'below'} {edge.lost:.3g} {unit}"


def _judgement(studies: Sequence[Study]) -> Text:
    missed = [entry.job.row.name for entry in studies if not verdict(entry.job.row, entry.score)]
    if missed:
        return Text(f"targets not met: {', '.join(missed)}", style="red")
    return Text("every target is met", style="green")


def _sensors(machine: str) -> str:
    return ", ".join(
        f"{entry.signal} {entry.noise:g} {entry.unit} and 12 bit over {entry.low:g} to {entry.high:g} {entry.unit}"
        for entry in SENSORS[machine]
    )


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", caption_justify="left")
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number > 1 else "left", no_wrap=True)
    return table


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100.0 * share:.3g}"
