"""The Modbus driver, and its probe."""
