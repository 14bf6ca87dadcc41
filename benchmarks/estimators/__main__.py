"""``python -m benchmarks.estimators``: everybody on the same windows, one table."""

import argparse
import importlib
import importlib.util
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict

from benchmarks.estimators.base import Budget, Rival
from benchmarks.estimators.measure import compare
from benchmarks.estimators.table import lines, verdicts

# Who takes part: a module of this package, and the library it needs beyond those of 'make bench's dev tools.
FIELD = (
    ("otolith_itself", ""),
    ("paper", ""),
    ("least_squares", ""),
    ("evolution", ""),
    ("unscented", "filterpy"),
    ("horizon", "casadi"),
)
QUICK = Budget(windows=2, dear=1, generations=20)


def main(arguments: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(arguments)
    budget = QUICK if asked.quick else Budget(asked.windows, asked.dear, drift=asked.drift / 100.0)
    rivals, missing = field(budget)
    rows = compare(rivals, budget, asked.seed)
    found = verdicts(rows)
    if asked.json:
        document = {
            "seed": asked.seed,
            "budget": asdict(budget),
            "rows": [asdict(row) for row in rows],
            "verdicts": [asdict(verdict) for verdict in found],
            "missing": missing,
        }
        print(json.dumps(document, indent=2))
        return 0
    print("\n".join(lines(rows)))
    print("errors and times: median, then 99th percentile over the windows; an interval should hold 95 % of the time")
    for module, library in missing.items():
        print(f"not compared: {module}, as {library} is not installed")
    for verdict in found:
        print(f"{'' if verdict.holds else 'MISSED: '}{verdict.sentence}")
    return 0


def field(budget: Budget) -> tuple[list[Rival], dict[str, str]]:
    """All whose library is installed, and of the others the library."""
    rivals: list[Rival] = []
    missing: dict[str, str] = {}
    for name, library in FIELD:
        if library and importlib.util.find_spec(library) is None:
            missing[name] = library
            continue
        rivals += importlib.import_module(f"benchmarks.estimators.{name}").rivals(budget)
    return rivals, missing


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimators", description=__doc__)
    parser.add_argument("--windows", type=int, default=Budget().windows, help="scored (%(default)s)")
    parser.add_argument("--dear", type=int, default=Budget().dear, help="of these, for the slowest (%(default)s)")
    parser.add_argument("--drift", type=float, default=0.0, help="of each parameter, %% an hour (none)")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="two windows, and the paper's swarm cut short")
    parser.add_argument("--json", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(main())
