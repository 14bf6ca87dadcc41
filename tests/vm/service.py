"""An instance of the shipped unit in the guest, installed as the README of the project says."""

import json
import os
import shutil
import subprocess
import time
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path

from otolith.health.schema import ReportDocument
from otolith.storage.history import HistoryReader
from tests.conftest import EXAMPLES
from tests.vm.conftest import PATIENCE, RESISTANCE, SCENARIO, WINDOW, Reports, run

ROOT = Path(__file__).parents[2]
SHARE = Path("/mnt/share")
PROGRAM = "/opt/otolith/bin/otolith"
STRANGER = "65533"  # a user of no group
TRUTH = {"R_a": RESISTANCE, "D": 0.00143}  # of the plant
# The motor of the other tests, simulated by the daemon, with a load that its twin lacks.
PLANT = (
    SCENARIO.partition("[bus]")[0]
    + """
[[faults]]
kind = "unbalance"
start = "0 s"
acceleration = "5 rad/s^2"
frequency = "10 rad/s"
"""
)


@dataclass(frozen=True)
class Before:
    """What an instance had when it was ended."""

    sequence: int
    window: int
    """Index of the last window."""
    events: dict[str, str]
    """State by id of each open event."""
    approved: list[str]
    """Components that an operator has approved."""


class Instance:
    """One machine of the service."""

    def __init__(self, name: str) -> None:
        self.name, self.unit = name, f"otolith@{name}"
        self.file, self.state = Path(f"/etc/otolith/{name}.toml"), Path(f"/var/lib/otolith/{name}")
        self.remembered = Path.home() / f"{name}.json"

    def shown(self, name: str) -> str:
        """A property of the unit."""
        return run("systemctl", "show", "--value", f"--property={name}", self.unit).strip()

    def log(self) -> str:
        """What it logged since the computer was booted."""
        return run("journalctl", "--boot", "--unit", self.unit, "--no-pager")

    def failure(self) -> str:
        """The log if it has ended; else empty."""
        return "" if self.shown("ActiveState") in {"active", "activating"} else self.log()

    def install(self, source: Path) -> None:
        """As the README says; /opt/otolith is there already. Kernels that are compiled are taken over."""
        run("systemd-sysusers", str(ROOT / "systemd" / "otolith.sysusers.conf"))
        compiled, cache = Path.home() / ".cache" / "otolith", Path("/var/cache/otolith")
        if compiled.exists() and not cache.exists():
            shutil.copytree(compiled, cache)
            run("chown", "--recursive", "otolith:otolith", str(cache))
        run(PROGRAM, "install", str(source), seconds=900.0)

    def otolith(self, *command: str, seconds: float = PATIENCE) -> str:
        """Output of a command of Otolith, as the user of the service."""
        environment = {**os.environ, "STATE_DIRECTORY": str(self.state), "NO_COLOR": "1"}
        done = subprocess.run(
            [PROGRAM, *command], env=environment, user="otolith", group="otolith", extra_groups=(), cwd="/",
            capture_output=True, text=True, timeout=seconds, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}: {done.stderr}"
        return done.stdout

    def history(self) -> HistoryReader:
        """The history of its machine, the only one."""
        (path,) = self.state.rglob("*.history.sqlite")
        return HistoryReader(path)

    def reports(self, after: int = 0) -> Reports:
        """The reports in its history with numbers above ``after``."""
        return [ReportDocument.from_json(text) for text in self.history().messages("report", 100_000, after)]

    def last(self) -> ReportDocument:
        """The newest report in its history."""
        return self.history().latest(1)[0]

    def wait_for_reports(self, count: int, after: int = 0, seconds: float = PATIENCE) -> Reports:
        """At least ``count`` reports with numbers above ``after``."""
        deadline = time.monotonic() + seconds
        while not list(self.state.rglob("*.history.sqlite")) or len(reports := self.reports(after)) < count:
            assert not (why := self.failure()), why
            assert time.monotonic() < deadline, f"no {count} reports within {seconds:g} s: {self.log()}"
            time.sleep(0.2)
        return reports

    def before(self) -> Before:
        """What it has now."""
        last = self.last()
        assert last.sequence is not None
        approved = json.loads(self.otolith("components", "list", str(self.file), "--json"))["approved"]
        return Before(last.sequence, last.window.index, {event.id: str(event.state) for event in last.events}, approved)

    def remember(self, before: Before) -> None:
        """Keep it for the next boot."""
        self.remembered.write_text(json.dumps(asdict(before)), encoding="utf-8")
        os.sync()

    def check_continued(self, before: Before) -> Reports:
        """The first reports after ``before``: what was learned, events and decisions are there."""
        deadline = time.monotonic() + PATIENCE
        while not (started := self._reports_after_start(before)):
            assert time.monotonic() < deadline, self.log()
            time.sleep(0.2)
        first = started[0]
        print(f"first report, of window {first.window.index}: {first.parameters}")
        holds_truth(first)
        assert first.notes == ()
        assert {event.id: str(event.state) for event in first.events} == before.events != {}
        assert [component.id for component in first.components if component.approval == "approved"] == before.approved
        numbers = [report.sequence or 0 for report in self.reports()]
        assert before.sequence in numbers
        assert numbers == sorted(set(numbers))
        return started

    def _reports_after_start(self, before: Before) -> Reports:
        """The reports that come after ``before`` and after those of the same process, whose windows count on."""
        last, reports = before.window, self.reports(before.sequence)
        for place, report in enumerate(reports):
            if report.window.index <= last:
                return reports[place:]
            last = report.window.index
        return []


class Hall(Instance):
    """The service of several machines."""

    def __init__(self) -> None:
        super().__init__("hall")
        self.unit, self.file = "otolith", Path("/etc/otolith/hall")

    def wait_for_all(self, names: Collection[str]) -> None:
        """Wait until each of the machines has a report in its history."""
        deadline = time.monotonic() + 2 * PATIENCE
        while self._told() < set(names):
            assert not (why := self.failure()), why
            assert time.monotonic() < deadline, self.log()
            time.sleep(0.5)

    def _told(self) -> set[str]:
        readers = [HistoryReader(path) for path in self.state.rglob("*.history.sqlite")]
        return {reader.machine for reader in readers if reader.messages("report", 1)}


def holds_truth(report: ReportDocument) -> None:
    """Check that each parameter has an interval with the true value in it.

    As one interval of 95 % in twenty misses it, twice the interval is checked, which never should.
    """
    assert set(report.parameters) == set(TRUTH)
    for name, found in report.parameters.items():
        assert found.value is not None
        assert found.low is not None
        assert found.high is not None
        assert abs(found.value - TRUTH[name]) <= found.high - found.low


def simulated_machine(folder: Path, extra: str = "", name: str = "press") -> Path:
    """A machine file for a motor that the daemon simulates."""
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    text = text.replace('scenario = "scenarios/demo.toml"', 'scenario = "press-plant.toml"')
    (folder / "press-plant.toml").write_text(PLANT, encoding="utf-8")
    file = folder / f"{name}.toml"
    file.write_text(f"{text}\n{WINDOW}{extra}", encoding="utf-8")
    return file


def learned_instance(folder: Path) -> Instance:
    """A service that has estimated, raised an event, and found a component that is approved."""
    previous = [str(path) for path in SHARE.glob("previous/*.whl")]
    if previous:
        install_wheel(*previous)
    press = Instance("press")
    press.install(simulated_machine(folder))
    run("systemctl", "enable", "--now", press.unit, seconds=300.0)
    deadline = time.monotonic() + 400.0
    press.wait_for_reports(1, seconds=300.0)
    while not ((report := press.last()).components and report.events):
        assert time.monotonic() < deadline, report.to_json()
        time.sleep(1.0)
    print(f"a component after {report.window.index} windows")
    component = report.components[0].id
    press.otolith("components", "approve", str(press.file), component)
    while press.last().components[0].approval != "approved":
        assert time.monotonic() < deadline
        time.sleep(0.5)
    return press


def install_wheel(*wheels: str) -> None:
    run("/opt/otolith/bin/pip", "--disable-pip-version-check", "install", "--quiet", "--no-index", "--no-deps",
        "--force-reinstall", *wheels, seconds=300.0)  # fmt: skip
