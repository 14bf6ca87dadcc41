"""Where reports go: Zenoh and Rerun recordings."""
