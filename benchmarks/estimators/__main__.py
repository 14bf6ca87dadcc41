"""``python -m benchmarks.estimators``: all estimators on the same windows, in one table."""

import argparse
import importlib
import importlib.util
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict

from benchmarks.estimators.base import Budget, Method
from benchmarks.estimators.measure import compare
from benchmarks.estimators.table import lines, verdicts

# Modules of this package, and the library that each needs beyond the development tools.
METHODS = (
    ("otolith_itself", ""),
    ("paper", ""),
    ("least_squares", ""),
    ("evolution", ""),
    ("unscented", "filterpy"),
    ("horizon", "casadi"),
)
QUICK = Budget(windows=2, slow=1, generations=20)


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    budget = QUICK if options.quick else Budget(options.windows, options.slow, drift=options.drift / 100.0)
    methods, missing = available_methods(budget)
    rows = compare(methods, budget, options.seed)
    conclusions = verdicts(rows)
    if options.json:
        document = {
            "seed": options.seed,
            "budget": asdict(budget),
            "rows": [asdict(row) for row in rows],
            "verdicts": [asdict(verdict) for verdict in conclusions],
            "missing": missing,
        }
        print(json.dumps(document, indent=2))
        return 0
    print("\n".join(lines(rows)))
    print("errors and times: median, then 99th percentile over the windows; an interval should hold 95 % of the time")
    for module, library in missing.items():
        print(f"not compared: {module}, as {library} is not installed")
    for verdict in conclusions:
        print(f"{'' if verdict.holds else 'MISSED: '}{verdict.sentence}")
    return 0


def available_methods(budget: Budget) -> tuple[list[Method], dict[str, str]]:
    """All methods whose library is installed, and the missing libraries by module."""
    methods: list[Method] = []
    missing: dict[str, str] = {}
    for name, library in METHODS:
        if library and importlib.util.find_spec(library) is None:
            missing[name] = library
            continue
        methods += importlib.import_module(f"benchmarks.estimators.{name}").methods(budget)
    return methods, missing


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimators", description=__doc__)
    parser.add_argument("--windows", type=int, default=Budget().windows, help="scored (%(default)s)")
    parser.add_argument("--slow", type=int, default=Budget().slow, help="of these, for slow methods (%(default)s)")
    parser.add_argument("--drift", type=float, default=0.0, help="of each parameter, %% an hour (none)")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="two windows, and the paper's swarm cut short")
    parser.add_argument("--json", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(main())
