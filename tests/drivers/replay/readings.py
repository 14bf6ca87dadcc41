"""The readings of a table, for tests."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from otolith_drivers.base import Setup, Signal
from otolith_drivers.replay.readers import format_of
from otolith_drivers.replay.table.options import TableOptions


def samples(
    path: Path, options: Mapping[str, object] | None = None, bad: int = 0, zone: str = "", **sources: dict[str, object]
) -> dict[str, list[tuple[float, float]]]:
    """Time (s) and value of each reading, by signal."""
    kind = format_of(path)
    units = {name: str(source.pop("of", "1")) for name, source in sources.items()}
    signals = tuple(
        Signal(name=name, unit=units[name], source=kind.Source.model_validate(source))
        for name, source in sources.items()
    )
    found = dict[str, list[tuple[float, float]]]()
    stated = None if options is None else TableOptions.model_validate(options)
    with kind.open_log(path, Setup(signals, path.parent, 0.01, timezone=zone), stated) as reader:
        for rows in reader.chunks():
            for name, values in rows.columns.items():
                present = np.isfinite(values)
                found.setdefault(name, []).extend(
                    zip(rows.times[present].tolist(), values[present].tolist(), strict=True)
                )
        assert reader.bad == bad
    return found
