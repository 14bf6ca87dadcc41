"""Speaking to systemd (sd_notify(3)) without its C library: readiness, status, watchdog."""

import os
import socket
from collections.abc import Mapping


class Notifier:
    """Silent where systemd is not the parent."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) if path else None
        microseconds, pid = environment.get("WATCHDOG_USEC"), environment.get("WATCHDOG_PID")
        ours = pid in (None, str(os.getpid()))
        self.watchdog = float(microseconds) / 1e6 if ours and microseconds and microseconds.isdigit() else None
        """Seconds within which systemd wants to hear of progress; None if it does not."""

    def ready(self, status: str) -> None:
        """The service does its work from now on."""
        self._send("READY=1", f"STATUS={_line(status)}", f"MAINPID={os.getpid()}")

    def status(self, status: str) -> None:
        """One line for ``systemctl status``."""
        self._send(f"STATUS={_line(status)}")

    def progress(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The service has begun to end."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Give the socket back."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> None:
        if self._socket is None:
            return
        try:  # a full queue would block without MSG_DONTWAIT; the next message tells the same
            self._socket.sendmsg(["\n".join(lines).encode()], [], socket.MSG_DONTWAIT, self._address)
        except OSError:
            return


def _line(text: str) -> str:
    return " ".join(text.split())
