"""A headless Chromium, driven over its DevTools protocol by a pipe: what a page shows, requests and logs."""

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
ANSWER_TIMEOUT = 120.0  # s
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-dev-shm-usage",
         "--remote-debugging-pipe")  # fmt: skip


def program() -> str | None:
    """Return the path of the browser; None where none is installed."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One tab. ``events`` has what the browser has announced since the last page was opened."""

    def __init__(self, commands: int, replies: int) -> None:
        self._commands = commands
        self._replies = replies
        self._number = 0  # of the last command
        self._rest = b""  # of what was read, after the last whole message
        self._session: dict[str, str] = {}
        self.events: list[dict[str, Any]] = []
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        attached = self._call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Network", "Runtime", "Log"):
            self._call(f"{domain}.enable")

    def open(self, page: Path | str, width: int, height: int, *, is_phone: bool = False, is_dark: bool = False) -> None:
        """Open a file or an address in a window of that size in pixels, as who prefers dark pages sees it or not."""
        scheme = {"name": "prefers-color-scheme", "value": "dark" if is_dark else "light"}
        self._call("Emulation.setEmulatedMedia", features=[scheme])
        self._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1,
                   mobile=is_phone)  # fmt: skip
        self.events.clear()
        self._call("Page.navigate", url=page if isinstance(page, str) else page.absolute().as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self._receive()

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        return self._call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def picture(self, *, is_whole: bool = False) -> bytes:
        """Return the window, or the whole page, as PNG."""
        shot = self._call("Page.captureScreenshot", format="png", captureBeyondViewport=is_whole)
        return base64.b64decode(shot["data"])

    def pages(self) -> bytes:
        """Return the page as it is printed on A4, as PDF."""
        printed = self._call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69, preferCSSPageSize=True)
        return base64.b64decode(printed["data"])

    def requested(self) -> list[str]:
        """Return the addresses of everything that the page has requested."""
        return [event["params"]["request"]["url"] for event in self.events
                if event["method"] == "Network.requestWillBeSent"]  # fmt: skip

    def console(self) -> list[str]:
        """Return what is in the console of the page: messages, errors and refused requests."""
        methods = {"Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"}
        return [json.dumps(event["params"]) for event in self.events if event["method"] in methods]

    def _call(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters, **self._session}
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while (reply := self._receive()).get("id") != self._number:
            pass
        if "error" in reply:
            raise RuntimeError(f"{method}: {reply['error']}")
        return reply["result"]

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            if not select.select([self._replies], [], [], ANSWER_TIMEOUT)[0]:
                raise TimeoutError(f"no answer of the browser for {ANSWER_TIMEOUT:g} s")
            if not (data := os.read(self._replies, 1 << 20)):
                raise RuntimeError("the browser has ended")
            self._rest += data
        text, _, self._rest = self._rest.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        if "method" in message:
            self.events.append(message)
        return message


@contextmanager
def browser(path: str, flags: Sequence[str] = ()) -> Iterator[Browser]:
    """A browser that ends with the block; ``path`` as :func:`program` returns it, ``flags`` are further ones."""
    theirs_in, commands = os.pipe()
    replies, theirs_out = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        # The protocol takes commands from file 3 and writes replies to file 4.
        script = (
            f"import os, sys; os.dup2({theirs_in}, 3); os.dup2({theirs_out}, 4); os.execv(sys.argv[1], sys.argv[1:])"
        )
        command = [sys.executable, "-c", script, path, *FLAGS, *flags, f"--user-data-dir={profile}", "about:blank"]
        with subprocess.Popen(  # noqa: S603 - a browser of this computer
            command, pass_fds=(theirs_in, theirs_out), stderr=subprocess.DEVNULL
        ) as process:
            os.close(theirs_in)
            os.close(theirs_out)
            try:
                yield Browser(commands, replies)
            finally:
                process.kill()
                os.close(commands)
                os.close(replies)
