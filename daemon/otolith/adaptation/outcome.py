"""How a window's search ended, each outcome a sentence."""

from enum import StrEnum


class Outcome(StrEnum):
    """What came of swarm and polish."""

    CONTINUED = "the polish went on from what was known"
    AGREED = "swarm and polish came to the same point"
    SWARM_WAS_BETTER = "the swarm found a better valley than the one that was known"
    POLISH_WAS_BETTER = "the swarm found nothing better than what was known"
    AMBIGUOUS = "swarm and polish disagree: different parameters explain the window equally well"
    NOTHING_TO_FIND = "the window says too little to search in"
    UNFINISHED = "neither swarm nor polish came to rest: the result is the best so far"
