"""Functional Mock-up Units of other tools as the white-box part of a twin: read, refused, loaded, called."""
