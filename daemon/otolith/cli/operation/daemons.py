"""The sessions of a reader: to the daemons that it names, or to all on this computer that it may read."""

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from otolith.publishing.zenoh_config import Credentials, local_sockets
from otolith.publishing.zenoh_session import Listener


class Daemons:
    """Passes the reports of the daemons at ``connect``, or of all on this computer that this user may read."""

    def __init__(
        self, connect: Sequence[str], key: str, on_report: Callable[[str], None], credentials: Credentials
    ) -> None:
        self._connect, self._credentials = tuple(connect), credentials
        self._key, self._on_report = key, on_report
        self._listeners: dict[tuple[str, ...], Listener] = {}

    def refresh(self) -> None:
        """Open a session for each socket that has appeared since."""
        for addresses in [self._connect] if self._connect else [(address,) for address in local_sockets()]:
            if addresses not in self._listeners:
                self._listeners[addresses] = Listener(addresses, self._key, self._on_report, self._credentials)

    def state(self) -> str:
        """Return what it waits for, in words."""
        addresses = ", ".join(address for session in self._listeners for address in session)
        if any(listener.connected for listener in self._listeners.values()):
            return f"connected, waiting for {self._key} ({addresses})"
        if self._connect:
            return f"no daemon reached yet, or it refuses this reader; --connect sets where to look ({addresses})"
        own = "no daemon of this user runs here, and no service that it may read"
        return f"{own}: members of the group otolith may; --connect sets where to look"

    def __enter__(self) -> Self:
        self.refresh()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for listener in self._listeners.values():
            listener.__exit__(kind, error, trace)
