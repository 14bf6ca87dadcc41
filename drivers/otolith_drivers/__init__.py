"""Where the samples of a machine come from: read-only drivers, and the simulated plant.

This package never imports ``otolith``; the daemon imports it.
"""
