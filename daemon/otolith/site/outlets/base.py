"""What outlets share: the view of a machine, notices of its events, and what an outlet does with both."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol

from otolith.health.limits import Level
from otolith.health.schema import EventDocument, Language, NoticeDocument, ReportDocument
from otolith.site.known import KnownMachine, RefusedFor
from otolith.site.serving.counts import Counts


class OutletError(Exception):
    """What an outlet could not pass on, and why; it is tried again, but for notices that were refused for good."""

    def __init__(self, reason: str, refused: int = 0) -> None:
        """``refused`` says how many of the notices that were removed the receiver will not take."""
        super().__init__(reason)
        self.refused = refused


class Told(StrEnum):
    """What a notice tells of an event."""

    RAISED = "raised"
    WORSE = "worse"
    BETTER = "better"
    CLEARED = "cleared"


@dataclass(frozen=True, slots=True)
class MachineView:
    """A machine at a moment; its texts are for people, with what controls a line or a screen escaped."""

    site: str
    name: str
    state: Level
    word: str  # Of the state, in the language of the outlets
    since: float | None  # Unix s; None while nothing is known
    what: str
    advice: str
    report: ReportDocument | None  # None while it is silent
    revision: tuple[object, ...]  # Another one after each change

    @property
    def key(self) -> str:
        """Site and name."""
        return f"{self.site}/{self.name}"


@dataclass(frozen=True, slots=True)
class Notice:
    """That an event was raised, has changed its state or was cleared, or that a machine is silent or heard again."""

    site: str
    machine: str
    told: Told
    event: EventDocument

    @property
    def key(self) -> str:
        """The same for each try to pass this notice on, and for no other notice."""
        at = self.event.since if self.event.end is None else self.event.end
        return f"{self.site}/{self.machine}/{self.event.id}/{self.told}/{at:.3f}"

    def document(self) -> Mapping[str, Any]:
        """Return it as a document: ``otolith.notice/1``."""
        event = self.event
        own = NoticeDocument(
            key=self.key, site=self.site, machine=self.machine, told=self.told.value,
            state=Level.OK if self.told is Told.CLEARED else event.state, part=event.part, condition=event.condition,
            text=event.text, cause=event.cause, advice=event.advice, start=event.start, since=event.since,
            end=event.end, event=event.id,
        )  # fmt: skip
        rows = own.model_dump(mode="json").items()
        return {name.rstrip("_"): value for name, value in rows if value not in (None, "")}


class Outlet(Protocol):
    """Passes on what is known, in a thread of its own; it may block for some seconds."""

    def send(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> bool:
        """Pass on machines that have changed, those that are ``gone``, and notices, each of which it then removes.

        After an error, and at first, ``views`` has all machines. Return whether the other side was reached: an outlet
        of notices has nothing to try without one.

        Raises:
            OutletError: something could not be passed on.
        """

    def close(self) -> None:
        """End it."""


@dataclass(slots=True)
class OutletStatus:
    """How an outlet does, for metrics and for the log."""

    name: str
    is_up: bool = False  # Whether the last try succeeded
    is_tried: bool = False
    reason: str = "not tried yet"
    failures: int = 0
    sent: int = 0  # Notices
    lost: int = 0  # Notices that were dropped, because of the limit per hour, after a long failure, or refused for good
    since: float = field(default_factory=time.time)


class Machines(Protocol):
    """Machines of which reports were taken, and how many were not."""

    @property
    def refused(self) -> Mapping[RefusedFor, int]:
        """Documents that were refused, by why."""

    def __iter__(self) -> Iterator[KnownMachine]:
        """Iterate over machines."""


class Known(Protocol):
    """What is known of machines, which is read while ``lock`` is held."""

    @property
    def lock(self) -> threading.Lock:
        """The lock."""

    @property
    def knowledge(self) -> Machines:
        """The machines."""

    @property
    def connected(self) -> bool:
        """Whether reports can come."""

    @property
    def hindered(self) -> Counts:
        """Who was refused or cut, by why."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Documents that came faster than they could be read, by where."""


@dataclass(frozen=True, slots=True)
class OutletSetup:
    """What an outlet is built with, besides its options."""

    folder: Path  # Of the file of the site
    title: str
    language: Language | None = None  # By default that of each machine, and English for texts about the site
    zone: str | None = None  # By default that of each machine
    sender: str = ""  # Who tells it: a machine and its site of a daemon; empty for a site
    known: Known | None = None  # For an outlet that others read
    statuses: Sequence[OutletStatus] = ()  # Of all outlets


Build = Callable[[Any, OutletSetup], Outlet]
