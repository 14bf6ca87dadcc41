"""Text tables and others with a row per instant: header, times, cells."""
