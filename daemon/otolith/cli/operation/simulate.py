"""``otolith simulate``: what the adapted twin of a machine predicts along given inputs, and what if."""

import re
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.common import FILE, MACHINE_FILE, new_file, use_state_of_service
from otolith.cli.operation.history import Since, age_or_date, write_page
from otolith.cli.terminal import echo, echo_csv, echo_json

if TYPE_CHECKING:
    from otolith.notebook import Twin
    from otolith.runtime.simulation_inputs import PlannedRows, RecordedStretch
    from otolith.simulation.prediction import Prediction

SCHEMA = "otolith.simulation/1"


def _value(_: click.Context, __: click.Parameter, written: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    pairs = [text.partition("=") for text in written]
    for text, (name, sign, value) in zip(written, pairs, strict=True):
        if not (name.strip() and sign and value.strip()):
            raise click.BadParameter(f"{text!r}: write a parameter and its value, like R_a=5.2 or 'R_a=5200 mohm'")
    values = tuple((name.strip(), value.strip()) for name, _, value in pairs)
    for name, count in Counter(name for name, _ in values).items():
        if count > 1:
            raise click.BadParameter(f"{name} has {count} values: give one")
    return values


def _span(_: click.Context, __: click.Parameter, text: str | None) -> tuple[str, str] | None:
    if text is None:
        return None
    begin, sign, end = text.partition("..")
    if not (begin and sign and end):
        raise click.BadParameter(f"{text!r}: write begin and end, like 20..80 or 2026-01-31T10:00..2026-01-31T10:05")
    return begin, end


def _moment(context: click.Context, option: click.Parameter, text: str | None) -> Since | None:
    return None if text is None else age_or_date(context, option, text)


def _output(context: click.Context, option: click.Parameter, path: Path | None) -> Path | None:
    return path if path == Path("-") else new_file(context, option, path)


@click.command()
@MACHINE_FILE
@click.option("--inputs", "data", type=FILE, metavar="DATA",
              help="Planned inputs as a table, or a recording.  [default: the daemon's recordings]")  # fmt: skip
@click.option("--span", callback=_span, metavar="BEGIN..END", help="Of a recording only this, in s or dates.")
@click.option("--after", "recordings", type=FILE, multiple=True, metavar="DATA",
              help="Adapt the twin to this recording, not to what a daemon has learned; may be repeated.")  # fmt: skip
@click.option("--at", "moment", callback=_moment, metavar="AGE|DATE",
              help="With the values of then, like 12h or 2026-01-31, from the history.")  # fmt: skip
@click.option("--set", "values", multiple=True, callback=_value, metavar="NAME=VALUE",
              help="What if a parameter has this value, in its unit or another; may be repeated.")  # fmt: skip
@click.option("--without", "removed", multiple=True, metavar="COMPONENT",
              help="What if the machine did not have this component; may be repeated.")  # fmt: skip
@click.option("--until-limit", is_flag=True, help="What if the trends go on until the next limit is passed.")
@click.option("--seed", type=click.IntRange(0), default=1, help="Of the random draws.")
@click.option("--csv", type=click.Path(path_type=Path, dir_okay=False, allow_dash=True), callback=_output,
              metavar="FILE", help="Write the prediction into this new file; '-' prints.")  # fmt: skip
@click.option("--parquet", type=FILE, callback=new_file, metavar="FILE", help="Write it into this new Parquet file.")
@click.option("--report", "page", type=FILE, callback=new_file, metavar="FILE", help="Plot it in this new HTML page.")
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def simulate(
    file: Path,
    data: Path | None,
    span: tuple[str, str] | None,
    recordings: tuple[Path, ...],
    moment: Since | None,
    values: tuple[tuple[str, str], ...],
    removed: tuple[str, ...],
    until_limit: bool,
    seed: int,
    csv: Path | None,
    parquet: Path | None,
    page: Path | None,
    as_json: bool,
) -> None:
    """Predict what the machine does along given inputs.

    The twin has the parameters, components and state that the daemon of FILE has
    learned. Each predicted reading has a 95 % band. DATA has a column 't' in
    seconds and one for each input, in its unit or the one in brackets. If it has
    all outputs as well it is a recording: its first window shows the state of the
    machine, and the rest is compared with the prediction.

    \b
    Examples:
      otolith simulate press-3 --inputs plan.csv --report plan.html
      otolith simulate press-3 --inputs plan.csv --set R_a=5.2 --csv hot.csv
      otolith simulate press-3 --inputs plan.csv --without shaft/periodic
      otolith simulate press-3 --inputs plan.csv --until-limit --json
      otolith simulate press-3 --inputs plan.csv --at 30d
      otolith simulate press-3 --span 2026-01-31T10:00..2026-01-31T10:05
      otolith simulate my-machine.toml --after monday.csv --inputs tuesday.csv
    """
    prints = as_json + (csv == Path("-"))
    _check(is_adapted=bool(recordings), has_moment=moment is not None, prints=prints)
    from otolith.cli.common import progress_line
    from otolith.notebook import Twin

    use_state_of_service(file)
    with progress_line("simulating", enabled=not as_json):
        twin = Twin.fresh(file) if recordings else Twin.load(file)
        source = _source(twin, data, span)
        twin = twin.adapted(*recordings) if recordings else twin
        twin = twin if moment is None else twin.at(moment.before(time.time(), twin.machine.plan.timezone))
        twin = _supposed(twin.at_limit() if until_limit else twin, values, removed)
        prediction = twin.simulate_along(source, seed=seed)
    for write, path in ((_write_parquet, parquet), (_write_page, page), (_write_csv, csv)):
        if path is not None:
            write(path, prediction, twin)
    if as_json:
        echo_json(_document(prediction, twin))
    elif csv != Path("-"):
        _print_summary(prediction, twin)
    if prediction.diverges is not None:
        echo(_divergence(prediction, twin), err=True)


def _check(*, is_adapted: bool, has_moment: bool, prints: int) -> None:
    """Raise UsageError if options exclude each other."""
    if has_moment and is_adapted:
        raise click.UsageError("give one of --at and --after: both say what the twin has learned")
    if prints > 1:
        raise click.UsageError("give one of --json and --csv -: both print")


def _supposed(twin: "Twin", values: tuple[tuple[str, str], ...], removed: tuple[str, ...]) -> "Twin":
    """Return the twin with the ``values`` of parameters, and without the components ``removed``."""
    from otolith.simulation.what_if import supposed_values
    from otolith_drivers.errors import ConfigurationError

    for name, value in values:
        if name in supposed_values(twin.posterior):
            fault = f"{name} has the value of its limit by --until-limit"
            raise ConfigurationError(f"--set {name}={value}: {fault}: leave one of them out")
        twin = twin.with_value(name, value)
    for key in removed:
        twin = twin.without(key)
    return twin


def _seconds(span: tuple[str, str], zone: str | None) -> tuple[float, float]:
    """Return begin and end of a span in s; a date without a zone is in that of the machine."""
    from datetime import datetime

    from otolith_drivers.common.time_zones import date_seconds

    ends = []
    for text in span:
        try:
            is_number = re.fullmatch(r"-?\d+(\.\d+)?", text)
            ends.append(float(text) if is_number else date_seconds(datetime.fromisoformat(text), zone))
        except (ValueError, OverflowError) as error:
            fault = f"{text!r}: write seconds, or a date like 2026-01-31T10:00"
            raise click.BadParameter(fault, param_hint="'--span'") from error
    if ends[0] >= ends[1]:
        raise click.BadParameter("it ends before it begins", param_hint="'--span'")
    return ends[0], ends[1]


def _source(twin: "Twin", data: Path | None, span: tuple[str, str] | None) -> "PlannedRows | RecordedStretch":
    """Return the inputs, after printing to standard error what a user must know of them."""
    from otolith.runtime.simulation_inputs import PlannedRows, read_inputs, read_recorded

    ends = None if span is None else _seconds(span, twin.machine.plan.timezone)
    if data is not None:
        source = read_inputs(twin.machine, data, ends)
    elif ends is not None:
        source = read_recorded(twin.machine, ends)
    else:
        raise click.UsageError("give --inputs with a plan or a recording, or --span of what the daemon has recorded")
    if not isinstance(source, PlannedRows):
        echo(*(f"{source.path}: {line}" for line in source.warnings), err=True)
    elif source.ignored:
        echo(f"{source.path}: columns not used: {', '.join(source.ignored)}", err=True)
    return source


def _divergence(prediction: "Prediction", twin: "Twin") -> str:
    moment = _moment_text(prediction.start + (prediction.diverges or 0.0), twin)
    remedy = "the values of --set, and intervals that contain unstable values, are the likely cause"
    return f"from {moment} on the twin diverges with values that are possible, so nothing is predicted: {remedy}"


def columns(prediction: "Prediction", twin: "Twin") -> dict[str, Any]:
    """Return the columns of a table, (records,) each, by their headers with units: a replay reads such tables."""
    table: dict[str, Any] = {"t [s]": prediction.times}
    for index, (name, unit) in enumerate(twin.inputs.items()):
        table[f"{name} [{unit}]"] = prediction.driving[:, index]
    for index, (name, unit) in enumerate(zip(prediction.outputs, prediction.units, strict=True)):
        table[f"{name} [{unit}]"] = prediction.values[:, index]
        table[f"{name} low [{unit}]"] = prediction.low[:, index]
        table[f"{name} high [{unit}]"] = prediction.high[:, index]
        if prediction.rmse(name) is not None:
            table[f"{name} measured [{unit}]"] = prediction.measured[:, index]
    return table


def _rows(prediction: "Prediction", twin: "Twin") -> list[tuple[object, ...]]:
    """Return the header and the rows of the table; an empty cell where nothing was measured."""
    table = columns(prediction, twin)
    lists = [[value if value == value else "" for value in column.tolist()] for column in table.values()]  # noqa: PLR0124 - NaN
    return [tuple(table), *zip(*lists, strict=True)]


def _write_csv(path: Path, prediction: "Prediction", twin: "Twin") -> None:
    rows = _rows(prediction, twin)
    if path == Path("-"):
        echo_csv(rows)
        return
    write_page(path, "".join(",".join(map(str, row)) + "\n" for row in rows).encode())


def _write_parquet(path: Path, prediction: "Prediction", twin: "Twin") -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = {
        name: pa.array(column, pa.float64(), from_pandas=True) for name, column in columns(prediction, twin).items()
    }
    try:
        pq.write_table(pa.table(table), path)
    except OSError as error:
        error.filename = str(path)  # pyarrow gives none
        raise


def _document(prediction: "Prediction", twin: "Twin") -> dict[str, Any]:
    names = twin.machine.file.machine
    parameters = {
        row.name: {"value": row.value, "sd": row.sd, "unit": row.unit, "estimated": row.is_estimated}
        for row in twin.parameters
    }
    outputs = {}
    for index, (name, unit) in enumerate(zip(prediction.outputs, prediction.units, strict=True)):
        curves = {"value": prediction.values, "low": prediction.low, "high": prediction.high}
        outputs[name] = {"unit": unit} | {key: curve[:, index].tolist() for key, curve in curves.items()}
        if (rmse := prediction.rmse(name)) is not None:
            measured = prediction.measured[:, index].tolist()
            outputs[name] |= {"measured": measured, "rmse": rmse, "coverage": prediction.coverage(name)}
    inputs = {
        name: {"unit": unit, "value": prediction.driving[:, index].tolist()}
        for index, (name, unit) in enumerate(twin.inputs.items())
    }
    return {
        "schema": SCHEMA,
        "machine": names.name,
        "site": names.site,
        "twin": twin.machine.twin.name,
        "state_time": twin.time,
        "supposed": list(twin.supposed),
        "parameters": parameters,
        "components": dict(twin.components),
        "seed": prediction.seed,
        "draws": prediction.draws,
        "diverges": None if prediction.diverges is None else prediction.start + prediction.diverges,
        "t": prediction.times.tolist(),
        "inputs": inputs,
        "outputs": outputs,
    }


def _moment_text(seconds: float, twin: "Twin") -> str:
    """Return a Unix time in the zone of the machine, or the time of a plan or log without dates."""
    from otolith.acquisition.quality import is_of_calendar
    from otolith.cli.common import local_time

    return local_time(seconds, twin.machine.plan.timezone) if is_of_calendar(seconds) else f"t = {seconds:.6g} s"


def _notes(twin: "Twin") -> list[str]:
    """Return of which state the prediction is, and what is supposed."""
    return [f"learned until {_moment_text(twin.time or 0.0, twin)}", *(f"what if: {line}" for line in twin.supposed)]


def _print_summary(prediction: "Prediction", twin: "Twin") -> None:
    """Print the value of each output at the end, its extremes, and how it agrees with what was measured."""
    from otolith_drivers.units import quantity_text

    echo(twin.machine.title, *_notes(twin))
    echo(*(f"with {key}: {text}" for key, text in twin.components.items()))
    first, last = (_moment_text(float(end), twin) for end in prediction.times[[0, -1]])
    echo(f"{prediction.records} records from {first} to {last}; intervals of 95 %")
    for index, (name, unit) in enumerate(zip(prediction.outputs, prediction.units, strict=True)):
        value, low, high = (part[:, index] for part in (prediction.values, prediction.low, prediction.high))
        end = quantity_text(float(value[-1]), unit, 0.5 * float(high[-1] - low[-1]))
        lowest, highest = (quantity_text(float(edge), unit) for edge in (value.min(), value.max()))
        line = f"  {name}: at the end {end}; from {lowest} to {highest}"
        if (rmse := prediction.rmse(name)) is not None:
            share = f"{prediction.coverage(name):.1%} within the band"
            line += f"; measured minus predicted: RMS {quantity_text(rmse, unit, digits=3)}, {share}"
        echo(line)


def _write_page(path: Path, prediction: "Prediction", twin: "Twin") -> None:
    from otolith.estimation.information import QUANTILE
    from otolith.health.text import texts_in
    from otolith.publishing.simulation_page import SimulatedMachine, SimulationRow, simulation_page
    from otolith_drivers.units import quantity_text

    names, texts = twin.machine.file.machine, texts_in(twin.machine.plan.language)
    rows = [
        SimulationRow(row.name, row.meaning, quantity_text(row.value, row.unit, QUANTILE * row.sd if row.sd else None))
        for row in twin.parameters
    ]
    machine = SimulatedMachine(names.name, names.site, twin.machine.twin, _notes(twin), rows, twin.components)
    write_page(path, simulation_page(prediction, machine, texts).encode())
