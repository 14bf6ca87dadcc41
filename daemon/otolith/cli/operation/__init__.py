"""The commands for machines in operation."""
