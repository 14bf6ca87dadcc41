"""Outlets of a site: what is known of its machines, for systems that are there already."""
