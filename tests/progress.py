"""A line every few seconds that names the tests which are running, in place of dots from several processes."""

import threading
import time
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from _pytest.terminal import TerminalReporter

INTERVAL = 10.0  # s between two lines


class Progress:
    """Plugin of the process that distributes tests to workers; a run in one process shows file names by itself."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._begun = time.monotonic()
        self._running: dict[str, float] = {}  # test to the time (s) when it started, in the order of starting
        self._finished = self._total = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._print_until_ended, name="progress", daemon=True)

    def pytest_sessionstart(self) -> None:
        self._thread.start()

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: list[str]) -> None:
        """Every worker collects the same tests."""
        self._total = len(ids)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._running[nodeid] = time.monotonic()

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        self._running.pop(nodeid, None)
        self._finished += 1

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report: pytest.TestReport) -> tuple[str, str, str] | None:
        """Count a passed test without printing a dot for it."""
        if report.passed and report.when == "call":
            return "passed", "", ""
        return None

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self) -> None:
        self._ended.set()
        self._thread.join()

    def line(self) -> str:
        """Elapsed minutes and seconds, tests finished, and the running tests with the seconds each has taken."""
        now = time.monotonic()
        minutes, seconds = divmod(round(now - self._begun), 60)
        running = ", ".join(f"{name} ({now - start:.0f} s)" for name, start in list(self._running.items()))
        return f"[{minutes:02}:{seconds:02}] {self._finished} of {self._total} tests; running: {running or 'none'}"

    def _print_until_ended(self) -> None:
        while not self._ended.wait(INTERVAL):
            reporter: TerminalReporter | None = self._config.pluginmanager.get_plugin("terminalreporter")
            if reporter is not None:
                reporter.ensure_newline()
                reporter.write_line(self.line())
