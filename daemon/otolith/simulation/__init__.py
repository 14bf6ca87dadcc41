"""What the adapted twin would do: predictions with 95 % bands. Pure: no clock, thread, socket or file."""
