"""How the twin learns from a window: objective, swarm, information. Pure: no clock, thread, socket or file."""
