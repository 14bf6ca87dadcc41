"""What the estimates mean: the status of each parameter, and the report."""
