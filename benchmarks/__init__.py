"""Benchmarks: timings as ratios within one run, accuracy, and comparisons."""
