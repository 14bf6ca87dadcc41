"""Recordings of months, replayed by several processes: of this computer, or of a cluster."""
