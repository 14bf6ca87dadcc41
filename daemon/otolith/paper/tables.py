"""What the studies found, as people read it."""

from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from otolith.health.report import Status
from otolith.paper.discovering import Discovery
from otolith.paper.found import discovery_pages
from otolith.paper.rows import PEAK, SENSORS
from otolith.paper.score import verdict
from otolith.paper.setting import percent, table, verdict_text
from otolith.paper.studies import BLUNT, LENGTH, Edge, Kind, Limit, Study


def pages(found: Sequence[Study | Limit | Discovery]) -> Iterator[RenderableType]:
    """All tables, in the order in which they are read."""
    studies = [entry for entry in found if isinstance(entry, Study)]
    ideal = [entry for entry in studies if entry.job.kind is Kind.IDEAL]
    noisy = [entry for entry in studies if entry.job.kind is Kind.NOISY]
    discoveries = [entry for entry in found if isinstance(entry, Discovery)]
    if ideal:
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
    yield from discovery_pages(discoveries)
    yield _judgement(ideal, discoveries)


def _against_the_paper(studies: Sequence[Study]) -> Table:
    title = f"relative error of the published value, windows of {LENGTH:g} s, ideal sensors, % (target)"
    made = table(title, "scenario", "parameter", "median", "99 % below", "largest", "", "paper")
    for entry in studies:
        row, error = entry.job.row, entry.score.published
        met = verdict(row, entry.score)
        made.add_row(
            row.name,
            row.parameter,
            percent(error.median),
            f"{percent(error.p99)} ({percent(row.target)})",
            f"{percent(error.maximum)} ({percent(PEAK * row.target)})",
            verdict_text(met=met),
            percent(row.paper),
        )
    made.caption = "paper: what it says that its error stays below, but for peaks"
    return made


def _circumstances(studies: Sequence[Study], sensors: str) -> Table:
    title = f"how it came about, windows of {LENGTH:g} s, {sensors}"
    made = table(
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
        made.add_row(
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
    made.caption = "first and worst are numbers of windows, all others counts from the first excited one on"
    return made


def _windows(studies: Sequence[Study], sensors: str) -> Table:
    title = f"error by length of the window, {sensors}, %"
    made = table(title, "scenario", "window", "", "median", "99 % below", "largest", "without")
    for entry in studies:
        for found in entry.scores:
            for number, (name, error) in enumerate((("alone", found.raw), ("published", found.published))):
                made.add_row(
                    entry.job.row.name if found is entry.scores[0] and not number else "",
                    "" if number else f"{found.length:g} s",
                    name,
                    percent(error.median),
                    percent(error.p99),
                    percent(error.maximum),
                    str(error.missing or ""),
                    end_section=found is entry.scores[-1] and number == 1,
                )
    made.caption = "alone: what each window says by itself, as the paper reports it; published: with those before it"
    return made


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


def _judgement(studies: Sequence[Study], discoveries: Sequence[Discovery]) -> Text:
    missed = [entry.job.row.name for entry in studies if not verdict(entry.job.row, entry.score)]
    missed += [f"{entry.job.row.name} ({entry.job.kind})" for entry in discoveries if not entry.met]
    if missed:
        return Text(f"targets not met: {', '.join(missed)}", style="red")
    return Text("every target is met", style="green")


def _sensors(machine: str) -> str:
    return ", ".join(
        f"{entry.signal} {entry.noise:g} {entry.unit} and 12 bit over {entry.low:g} to {entry.high:g} {entry.unit}"
        for entry in SENSORS[machine]
    )
