"""What a table offers."""

import os
from pathlib import Path

import numpy as np

from otolith.acquisition.window import Array
from otolith.cli.commissioning.draft.offers import Offer, OfferedSource, unit_in
from otolith_drivers.errors import ConfigurationError, counted
from otolith_drivers.grammars.toml_lines import toml_value
from otolith_drivers.replay.readers import holds_frames
from otolith_drivers.replay.table.columns import offered_columns, read_columns

MAX_ROWS = 100_000  # that are looked at


def table_offers(path: Path, folder: Path) -> OfferedSource:
    """Return what the table at ``path`` offers to a machine file in ``folder``; ConfigurationError if it is none."""
    if holds_frames(path):
        raise ConfigurationError(f"{path}: a log of a CAN bus: give it as --log, with the --dbc of its frames")
    columns = offered_columns(path)
    if not columns:
        raise ConfigurationError(f"{path}: no column beside that of the time has a name of its own")
    with read_columns(path, columns) as reader:
        times, rows = list[Array](), 0
        values: dict[str, list[Array]] = {column.name: [] for column in columns}
        for chunk in reader.chunks():
            times.append(chunk.times)
            for name, numbers in chunk.columns.items():
                values[name].append(numbers)
            rows += len(chunk.times)
            if rows >= MAX_ROWS:
                break
        assumptions, warnings = reader.assumptions(), reader.warnings()
    clock = np.concatenate(times)
    offers = []
    for column in columns:
        numbers = np.concatenate(values[column.name])
        present = np.isfinite(numbers)
        steps = np.diff(clock[present])
        if not present.any():
            continue
        interval = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else None
        unit = column.unit or unit_in(column.name)
        offers.append(Offer(column.name, unit, {"column": column.name}, numbers[present], interval))
    if not offers:
        raise ConfigurationError(f"{path}: no column has numbers")
    duration = float(np.ptp(clock))
    left = [column.name for column in columns if column.name not in {offer.name for offer in offers}]
    said = dict.fromkeys(assumptions if left else warnings)  # a reader of several says it for each
    remarks = [*(f"no numbers in column {name}" for name in left), *said]
    driver = ("[driver]", 'type = "replay"', f"file = {toml_value(seen_from(path, folder))}")
    title = f"{path}: {counted(rows, 'row')} in {duration:.6g} s"
    return OfferedSource(title, driver, offers, duration, check=str(path), remarks=remarks)


def seen_from(path: Path, folder: Path) -> str:
    """Return the path of a file as a machine file in ``folder`` names it: relative if it is in or below that."""
    whole = Path(os.path.abspath(path))  # noqa: PTH100 - a link stays the link that was named
    base = Path(os.path.abspath(folder))  # noqa: PTH100 - the same
    return str(whole.relative_to(base)) if whole.is_relative_to(base) else str(whole)
