"""Simulated machines that stand in for real ones: own equations, own controllers, faults by scenario.

They import nothing of the daemon, so that the twin is never checked against itself.
"""
