"""Recorded samples: tables as text, logs of a CAN bus, our own recordings. All become rows of numbers."""
