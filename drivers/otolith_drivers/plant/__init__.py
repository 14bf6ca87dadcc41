"""Simulated machines with their own equations, controllers and faults.

They import nothing of the daemon, so that the twin is never checked against itself.
"""
