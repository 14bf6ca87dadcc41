"""A site as a process of its own, and requests to it."""

import http.client
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
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
    """The last lines that a process wrote, read as they come: a pipe that nobody reads would block it once it is full.
    """

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

    @property
    def address(self) -> str:
        """Of its hall."""
        return f"http://127.0.0.1:{self.port}/"

    def ask(self, path: str, method: str = "GET", **headers: str) -> Answer:
        """Send a request with headers, and return its answer; ``host`` replaces its own."""
        connection = self.open(path, method, **headers)
        answer = connection.getresponse()
        found = {name.lower(): value for name, value in answer.getheaders()}
        text = answer.read().decode()
        connection.close()
        return Answer(answer.status, found, text)

    def open(self, path: str, method: str = "GET", **headers: str) -> http.client.HTTPConnection:
        """Send a request, and return its connection."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        own = {"host": f"127.0.0.1:{self.port}"} | {name.replace("_", "-"): value for name, value in headers.items()}
        connection.putrequest(method, path, skip_host=True)
        for name, value in own.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection


@contextmanager
def serving(folder: Path, *endpoints: str, more: str = "", tables: str = "") -> Iterator[Served]:
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
            assert f"http://127.0.0.1:{port}/" in said.first(), said.now()
            yield Served(port, process, said)
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
