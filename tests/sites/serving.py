"""A site as a process of its own, and requests to it."""

import http.client
import socket
import ssl
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.conftest import free_port
from tests.waiting import PATIENCE


@dataclass(frozen=True, slots=True)
class Answer:
    """What a request was answered with."""

    status: int
    headers: dict[str, str]
    text: str


class Said:
    """The last lines that a process wrote, read as they come: a full pipe that nobody reads would block it."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._lines: deque[str] = deque(maxlen=1000)
        self._first, self._process = threading.Event(), process
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for line in self._process.stderr or ():
            self._lines.append(line)
            self._first.set()
        self._first.set()

    def first(self) -> str:
        """Wait for its first line; empty if it ended without one."""
        assert self._first.wait(PATIENCE)
        return self._lines[0] if self._lines else ""

    def all(self) -> str:
        """Return what it has written until it ended."""
        self._thread.join(PATIENCE)
        return self.now()

    def now(self) -> str:
        """Return what it has written so far."""
        return "".join(tuple(self._lines))


@dataclass(frozen=True, slots=True)
class Served:
    """A site that runs."""

    port: int
    process: "subprocess.Popen[str]" = field(repr=False)
    said: Said = field(repr=False)
    tls: ssl.SSLContext | None = field(default=None, repr=False)
    """With the certificate of a user, if the site is encrypted."""

    @property
    def address(self) -> str:
        """Of its hall."""
        return f"{'http' if self.tls is None else 'https'}://127.0.0.1:{self.port}/"

    def ask(self, path: str, method: str = "GET", content: bytes = b"", **headers: str) -> Answer:
        """Send a request with headers, and return its answer; ``host`` replaces its own."""
        with closing(self._connection()) as connection:
            self._send(connection, path, method, content, headers)
            answer = connection.getresponse()
            found = {name.lower(): value for name, value in answer.getheaders()}
            return Answer(answer.status, found, answer.read().decode())

    def open(self, path: str, method: str = "GET", **headers: str) -> http.client.HTTPConnection:
        """Send a request, and return its connection."""
        connection = self._connection()
        self._send(connection, path, method, b"", headers)
        return connection

    def _connection(self) -> http.client.HTTPConnection:
        if self.tls is None:
            return http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        return http.client.HTTPSConnection("127.0.0.1", self.port, timeout=PATIENCE, context=self.tls)

    def _send(
        self, connection: http.client.HTTPConnection, path: str, method: str, content: bytes, headers: dict[str, str]
    ) -> None:
        if content:
            headers = {"content_length": f"{len(content)}", **headers}
        own = {"host": f"127.0.0.1:{self.port}"} | {name.replace("_", "-"): value for name, value in headers.items()}
        connection.putrequest(method, path, skip_host=True)
        for name, value in own.items():
            connection.putheader(name, value)
        connection.endheaders(content or None)


@contextmanager
def serving(
    folder: Path, *endpoints: str, more: str = "", tables: str = "", tls: ssl.SSLContext | None = None
) -> Iterator[Served]:
    """A site that reads endpoints; ``more`` are lines at the begin of its file, ``tables`` at its end."""
    port = free_port(socket.SOCK_STREAM)
    file = folder / "site.toml"
    file.write_text(
        f'{more}\n[http]\nlisten = "127.0.0.1:{port}"\n[zenoh]\nconnect = {list(endpoints)}\n{tables}', encoding="utf-8"
    )
    command = [sys.executable, "-m", "otolith", "site", str(file)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            said = Said(process)
            served = Served(port, process, said, tls)
            assert served.address in said.first(), said.now()
            yield served
        finally:
            process.terminate()
            process.wait(PATIENCE)


@contextmanager
def router(script: str, argument: str) -> Iterator[None]:
    """A router as a process of its own: ``script`` prints that it is open, and ends with its input."""
    command = [sys.executable, "-c", script, argument]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        try:
            yield
        finally:
            process.kill()
