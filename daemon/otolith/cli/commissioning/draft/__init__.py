"""``otolith init``: a first machine file from what a recording or a bus offers."""
