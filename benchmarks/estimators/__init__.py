"""Otolith compared with other estimators, on the same windows in the same run: ``python -m benchmarks.estimators``."""
