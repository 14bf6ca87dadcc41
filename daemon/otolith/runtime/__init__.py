"""Processes and threads of the daemon."""
