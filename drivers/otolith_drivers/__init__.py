"""Read-only drivers that turn what a machine sends into samples, and the simulated plant.

This package never imports ``otolith``; the daemon imports it.
"""
