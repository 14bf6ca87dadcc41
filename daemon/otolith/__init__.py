"""Otolith: an edge daemon that makes an industrial machine aware of itself."""

__version__ = "0.1.0"
