"""What systemd is told about the service."""

import os
import socket
from collections.abc import Mapping

from otolith_drivers.outside_text import visible

MAX_STATUS = 1000  # characters of a line for systemd, beyond which it is cut: a datagram that is too long is not sent


class Notifier:
    """Notifications to systemd, sd_notify(3), without its C library. Without systemd it sends nothing."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) if path else None
        microseconds, pid = environment.get("WATCHDOG_USEC"), environment.get("WATCHDOG_PID")
        for_us = pid in (None, str(os.getpid()))
        self.watchdog = float(microseconds) / 1e6 if for_us and microseconds and microseconds.isdigit() else None
        """Timeout of systemd's watchdog in s, or None if there is no watchdog."""

    def send(self, *assignments: str) -> None:
        """Send assignments such as ``READY=1``; line breaks in them are escaped, as each line is an assignment."""
        if self._socket is None:
            return
        text = "\n".join(visible(assignment, MAX_STATUS) for assignment in assignments)
        try:  # MSG_DONTWAIT: a full queue must not block; a dropped message is repeated by the next one
            self._socket.sendmsg([text.encode()], [], socket.MSG_DONTWAIT, self._address)
        except OSError:
            return

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
