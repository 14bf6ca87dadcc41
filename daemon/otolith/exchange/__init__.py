"""The adapted twin for other tools: as a Python program, a Modelica model, or an FMU. Pure: no clock, thread, file."""
