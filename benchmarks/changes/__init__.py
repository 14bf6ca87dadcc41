"""What the reports state after a change of a simulated machine: ``python -m benchmarks.changes``."""
