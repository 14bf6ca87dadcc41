"""What a site counts of those who are refused or cut, for its metrics."""

from collections import Counter
from enum import StrEnum


class Hindered(StrEnum):
    """Who got no answer, or not all of it, and why."""

    HISTORY_BUSY = "history_busy"  # Too many pages of the past wait
    HISTORY_ADDRESS = "history_address"  # Too many of them are for this address
    LIVE = "live"  # Too many browsers get live events
    IDLE = "idle"  # No whole request came in time
    SLOW = "slow"  # The reader took nothing for too long
    MEMORY = "memory"  # Too much waited for all readers together
    ROOM = "room"  # A new connection had its place
    UNANSWERED = "unanswered"  # A query of the past that a daemon refused or did not answer


Counts = Counter[Hindered]
REASONS = {
    "otolith_site_requests_refused_total": (
        "Requests that were refused as there were too many.",
        (Hindered.HISTORY_BUSY, Hindered.HISTORY_ADDRESS, Hindered.LIVE),
    ),
    "otolith_site_connections_cut_total": (
        "Connections that were cut so that others are served.",
        (Hindered.IDLE, Hindered.SLOW, Hindered.MEMORY, Hindered.ROOM),
    ),
    "otolith_site_history_queries_failed_total": (
        "Queries of the past that daemons refused or did not answer.",
        (Hindered.UNANSWERED,),
    ),
}
"""Metrics with their text and the values of their label ``reason``."""
