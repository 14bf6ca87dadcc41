"""From samples to windows: ring buffers, alignment to the sampling grid, window quality."""
