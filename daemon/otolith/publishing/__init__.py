"""Publishing of reports: Zenoh and Rerun recordings."""
