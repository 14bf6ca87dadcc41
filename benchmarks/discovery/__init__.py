"""How often the search identifies components, compared with PySINDy: ``python -m benchmarks.discovery``."""
