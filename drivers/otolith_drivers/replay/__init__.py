"""Recorded data as rows of numbers: text tables, CAN logs, recordings of Otolith."""
