"""The CAN driver."""
