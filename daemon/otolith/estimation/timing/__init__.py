"""Delays of signals: windows as other delays would give them, and how innovations depend on a delay."""
