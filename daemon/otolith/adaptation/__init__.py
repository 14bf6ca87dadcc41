"""What a window changes: state and report. Pure: no clock, thread, socket or file."""
