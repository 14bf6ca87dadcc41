"""One connection for all drivers of this process that read at the same place: a bus, a line, a host, a server.

A driver opts in by :meth:`SharedConnection.join`: the first one makes the connection, each further one gets the same,
and the last one that leaves closes it. What identifies a place is said by the driver. If a place can be opened several
times, everything by which two connections would differ belongs to it, so that a driver that wants another one gets its
own. If it can be opened only once, the drivers must agree on the options.
"""

import logging
import threading
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Generic, Self, TypeVar

from otolith_drivers.base import Deliver, Sample
from otolith_drivers.common.reconnection import CLOSE_TIMEOUT, OwnFaults
from otolith_drivers.errors import DeviceError

Place = tuple[Hashable, ...]  # Begins with the name of the driver
User = TypeVar("User")

_lock = threading.Lock()  # Of all below; nothing that waits is done under it
_connections: dict[Place, "SharedConnection[Any]"] = {}  # That are in use, or being closed


class SharedConnection(Generic[User]):
    """Base of a connection with its users. What a user does must neither raise nor wait in the connection's thread."""

    def __init__(self) -> None:
        self.users: tuple[User, ...] = ()  # Never changed, only replaced: any thread may walk through it
        self._place: Place = ()
        self._agreed: Mapping[str, object] = {}
        self._is_left, self._closed = False, threading.Event()

    @classmethod
    def join(
        cls, place: Place, user: User, make: Callable[[], Self], options: Mapping[str, object] | None = None
    ) -> Self:
        """Return the connection to ``place``, of which ``user`` is a user from now on; ``make`` makes one, not open.

        Raises:
            DeviceError: others use the place with other ``options``, or it is not closed in time.
        """
        options = options or {}
        while True:
            with _lock:
                there = _connections.get(place)
                if there is None:
                    there = _connections[place] = make()
                    there._place, there._agreed = place, options
                if not there._is_left:
                    if differing := _differences(there._agreed, options):
                        text = f"another machine or source uses this connection with other options: {differing}"
                        raise DeviceError(text)
                    there.users += (user,)
                    there.users_changed()
                    return there  # type: ignore[return-value]  # a place begins with the name of its driver
            if not there._closed.wait(CLOSE_TIMEOUT):
                raise DeviceError("the connection before this one is still being closed")

    def leave(self, user: User) -> None:
        """Use the connection no longer; the last user closes it. May be called twice."""
        with _lock:
            before, self.users = self.users, tuple(each for each in self.users if each is not user)
            if self.users or not before:
                self.users_changed()
                return
            self._is_left = True
        try:
            self.close()
        finally:
            with _lock:
                del _connections[self._place]
            self._closed.set()

    def is_last_use_of(self, user: User) -> bool:
        """Return whether nobody else uses the connection; then nobody joins it any more, so it may be broken off."""
        with _lock:
            self._is_left = self._is_left or self.users == (user,)
            return self._is_left

    def users_changed(self) -> None:
        """Note that ``users`` is another one; must not wait."""

    def close(self) -> None:
        """Close the connection within a second: nobody uses it any more."""
        raise NotImplementedError


class Delivery:
    """Where the samples of one user go, until it leaves; nothing that this does reaches the other users."""

    def __init__(self, deliver: Deliver, log: logging.Logger) -> None:
        self._deliver, self._own_faults, self._has_ended = deliver, OwnFaults(log), False
        self._delivering = threading.Lock()

    def hand_over(self, samples: Sequence[Sample]) -> None:
        """Deliver ``samples``, if there are any."""
        if not samples:
            return
        with self._delivering:
            if self._has_ended:
                return
            try:
                self._deliver(samples)
            except Exception as error:  # noqa: BLE001 - the thread serves all users
                self._own_faults.note(error, f"delivering {len(samples)} samples", time.monotonic())

    def end(self) -> None:
        """Deliver nothing from now on; waits for a delivery that is under way, but not for long."""
        self._has_ended = True
        if self._delivering.acquire(timeout=CLOSE_TIMEOUT):
            self._delivering.release()

    def defect(self, now: float) -> str:
        """Return what went wrong lately at ``now`` (s); empty if nothing."""
        return self._own_faults.defect(now)


def places() -> list[Place]:
    """Return the places to which there are shared connections."""
    with _lock:
        return list(_connections)


def _differences(there: Mapping[str, object], here: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {there[name]} there and {here[name]} here" for name in here if there[name] != here[name])
