"""What the studies found, as one JSON document. Errors are shares, not per cent; what is unknown is absent."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from otolith.paper.discovering import Course, Discovery
from otolith.paper.rows import PEAK, SENSORS
from otolith.paper.score import Score, Spread, verdict
from otolith.paper.studies import Kind, Limit, Study
from otolith.paper.unknowns import NOISE

SCHEMA = "otolith.paper/1"


def document(found: Sequence[Study | Limit | Discovery], plots: Sequence[Path]) -> str:
    """One line."""
    studies = [entry for entry in found if isinstance(entry, Study)]
    ideal = [entry for entry in studies if entry.job.kind is Kind.IDEAL]
    discoveries = [entry for entry in found if isinstance(entry, Discovery)]
    whole = {
        "schema": SCHEMA,
        "met": all(verdict(entry.job.row, entry.score) for entry in ideal) and all(entry.met for entry in discoveries),
        "scenarios": [_scenario(entry) | _targets(entry) for entry in ideal],
        "noisy": [_scenario(entry) | _sensors(entry) for entry in studies if entry.job.kind is Kind.NOISY],
        "unknown": [_discovery(entry) for entry in discoveries if entry.job.kind is Kind.IDEAL],
        "unknown_noisy": [_discovery(entry) for entry in discoveries if entry.job.kind is Kind.NOISY],
        "lost_in_noise": [_limit(entry) for entry in found if isinstance(entry, Limit)],
        "plots": [str(path) for path in plots],
    }
    return json.dumps(_content(whole), allow_nan=False)


def _content(value: Any) -> Any:
    """Without what is None."""
    if isinstance(value, dict):
        return {key: _content(entry) for key, entry in value.items() if entry is not None}
    return [_content(entry) for entry in value] if isinstance(value, list) else value


def _scenario(entry: Study) -> dict[str, Any]:
    row = entry.job.row
    return {
        "name": row.name,
        "parameter": row.parameter,
        "seconds": entry.job.seconds,
        **_score(entry.score),
        "window_study": [_score(found) for found in entry.scores],
    }


def _targets(entry: Study) -> dict[str, Any]:
    row = entry.job.row
    target = {"p99": row.target, "maximum": PEAK * row.target}
    return {"target": target, "met": verdict(row, entry.score), "paper": row.paper}


def _sensors(entry: Study) -> dict[str, Any]:
    return {
        "sensors": {
            sensor.signal: {"unit": sensor.unit, "noise": sensor.noise, "range": [sensor.low, sensor.high], "bits": 12}
            for sensor in SENSORS[entry.job.row.machine]
        }
    }


def _score(found: Score) -> dict[str, Any]:
    return {
        "window_s": found.length,
        "windows": found.windows,
        "first_excited": found.begun if found.begun < found.windows else None,
        "first_estimated": found.first,
        "worst": found.worst,
        "published": _spread(found.published),
        "raw": _spread(found.raw),
        "coverage": found.coverage,
        "statuses": found.statuses,
        "determined_alone": found.alone,
        "rmse": found.rmse,
    }


def _spread(error: Spread) -> dict[str, Any]:
    return {"median": error.median, "p99": error.p99, "maximum": error.maximum, "missing": error.missing}


def _limit(found: Limit) -> dict[str, Any]:
    return {
        "machine": found.job.row.machine,
        "parameter": found.job.row.parameter,
        "sensor": found.sensor.signal,
        "unit": found.sensor.unit,
        "alone": {"kept": found.alone.kept, "lost": found.alone.lost},
        "together": {"kept": found.together.kept, "lost": found.together.lost},
        "unaided": {"kept": found.unaided.kept, "lost": found.unaided.lost},
    }


def _discovery(entry: Discovery) -> dict[str, Any]:
    row, noisy = entry.job.row, entry.job.kind is Kind.NOISY
    before, after = row.paper or (None, None)
    return {
        "name": row.name,
        "component": row.component,
        "seconds": entry.job.seconds,
        "noise_share": NOISE if noisy and not row.sensors else None,
        "begun_s": entry.begun,
        "suspected_s": entry.suspected,
        "adopted_s": entry.adopted,
        "onset_s": entry.onset,
        "kept": entry.kept,
        "others": list(entry.others),
        "equation": entry.equation,
        "numbers": {course.number.name: _course(course, noisy=noisy) for course in entry.courses},
        "largest_error": {"before": entry.before, "after": entry.after},
        "target": None if noisy else {row.output: row.within},
        "paper": {"before": before, "after": after},
        "met": entry.met,
    }


def _course(found: Course, *, noisy: bool) -> dict[str, Any]:
    """The numbers of the last window, and the largest error since the discovery."""
    known = np.isfinite(found.value)
    if not known.any():
        return {"truth": float(found.truth[-1])}
    last = int(np.flatnonzero(known)[-1])
    return {
        "value": float(found.value[last]),
        "low": float(found.low[last]),
        "high": float(found.high[last]),
        "unit": found.unit,
        "truth": float(found.truth[last]),
        "error": float(found.errors[last]),
        "largest_error": float(np.nanmax(found.errors)),
        "target": found.number.noisy if noisy else found.number.target,
        "paper": found.number.paper,
        "coverage": found.coverage,
    }
