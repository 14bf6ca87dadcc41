"""Commands of persons to a daemon: signed by who sends them, checked and carried out by the daemon."""
