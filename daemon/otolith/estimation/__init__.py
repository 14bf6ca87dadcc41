"""Step 2 of the method: parameters from one window, and the filter across windows."""
