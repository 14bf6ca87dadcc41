"""What persons decide about events: the commands that a specialist gives, and those that named users send."""
