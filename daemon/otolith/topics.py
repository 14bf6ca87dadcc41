"""The table of what is published: one row per kind of Zenoh key."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of key."""

    key: str
    """Under ``otolith/<site>/<machine>/``; ``*`` stands for a name."""
    content: str
    rate: str

    def under(self, site: str, machine: str, name: str = "") -> str:
        """The whole key."""
        return f"{prefix(site, machine)}/{self.key.replace('*', name)}"


REPORT = Topic("report", "JSON document otolith.report/1; the latest one answers a query", "once per window")
PARAMETER = Topic("parameter/*", "JSON object: the entry of one parameter in the report", "once per window")
ALIVE = Topic("alive", "liveliness token", "while the daemon runs")

TOPICS = (REPORT, PARAMETER, ALIVE)


def prefix(site: str, machine: str) -> str:
    """What all keys of a machine begin with."""
    return f"otolith/{site}/{machine}"
