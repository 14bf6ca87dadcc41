"""Step 3 of the method: what the twin does not explain."""
