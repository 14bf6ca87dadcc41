"""The site: what is known of all machines, as pages and for other systems; it reads Zenoh only."""
