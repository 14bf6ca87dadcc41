"""What an installed service does in trouble: a full disk, a wrong clock, stopped processes. In the guest, as root."""

import os
import signal
import time
from pathlib import Path

from otolith.health.schema import EventDocument, ReportDocument, Status
from tests.vm.conftest import PATIENCE, ReportListener, Reports, counters, good, run
from tests.vm.service import Instance, holds_truth

YEAR = 365.25 * 86_400.0  # s
FILL_PIECES = (1 << 20, 1 << 12, 1)  # blocks: large ones first
FILLER = Path("/var/lib/otolith/filler")
MAX_WARNINGS = 12  # lines: of each process and thread that writes, when it is refused and when it goes on


def listener(press: Instance) -> ReportListener:
    (socket,) = Path("/run/otolith/press").glob("*.sock")
    return ReportListener(f"unixsock-stream/{socket}", press.failure)


def check_estimates(press: Instance, reports: Reports, restarts: str) -> None:
    """The daemon has not been restarted, and its newest report has every parameter."""
    assert press.shown("NRestarts") == restarts, press.log()
    holds_truth(reports[-1])
    assert {parameter.status for parameter in reports[-1].parameters.values()} <= {Status.ESTIMATED, Status.HELD}


def limits_in(events: tuple[EventDocument, ...]) -> set[str]:
    """Ids of the events about a parameter; that of the component is cleared, as an operator has approved it."""
    return {event.id for event in events if event.id.startswith("limit/")}


def is_now(report: ReportDocument) -> bool:
    """Whether the window of a report has the time that the clock has: some windows wait for a busy worker."""
    return abs(time.time() - report.window.end) < PATIENCE


def fill_disk() -> None:
    """Leave no byte of the disk to users other than root."""
    with FILLER.open("wb") as file:
        size = 0
        while (status := os.statvfs(FILLER)).f_bavail:
            length = status.f_bavail * status.f_frsize
            os.posix_fallocate(file.fileno(), size, length)
            size += length


def test_processes_that_are_stopped_are_replaced(press: Instance) -> None:
    """Worker and recorder: no signal says that a process does nothing any more."""
    main, restarts = press.shown("MainPID"), press.shown("NRestarts")
    before = counters(press.reports())
    for child in Path(f"/proc/{main}/task/{main}/children").read_text(encoding="ascii").split():
        if b"resource_tracker" not in Path(f"/proc/{child}/cmdline").read_bytes():
            os.kill(int(child), signal.SIGSTOP)
    deadline = time.monotonic() + PATIENCE
    while (after := counters(press.reports())).worker_restarts == before.worker_restarts or (
        after.recorder_restarts == before.recorder_restarts
    ):
        assert time.monotonic() < deadline, press.log()
        time.sleep(0.5)
    last = press.reports()[-1].sequence or 0
    check_estimates(press, press.wait_for_reports(2, after=last), restarts)


def test_a_clock_that_is_a_year_off_costs_nothing(press: Instance) -> None:
    before, restarts = press.reports()[-1], press.shown("NRestarts")
    for shift in (YEAR, -2.0 * YEAR, YEAR):
        last = press.reports()[-1].sequence or 0
        time.clock_settime(time.CLOCK_REALTIME, time.time() + shift)
        deadline = time.monotonic() + PATIENCE
        while len(reports := [report for report in good(press.reports(last)) if is_now(report)]) < 4:
            assert time.monotonic() < deadline, press.log()
            time.sleep(0.5)
        print(f"the clock was set by {shift / YEAR:+.0f} years: {reports[-1].window.end}, {reports[-1].events}")
        check_estimates(press, reports, restarts)
        assert limits_in(reports[-1].events) == limits_in(before.events) != set()
    assert "R_a" in press.otolith("history", "press", "--since", "1h")
    assert press.before().approved == [row.id for row in before.components if row.approval == "approved"] != []


def test_a_full_disk_costs_no_monitoring_and_what_waits_is_written_later(press: Instance) -> None:
    """Not even a daemon that starts while no byte is free forgets what it has learned."""
    before, restarts = press.reports()[-1], press.shown("NRestarts")
    begun = run("date", "+%F %T").strip()
    received = listener(press)
    fill_disk()
    try:
        received.wait_for(lambda reports: len(good(reports)) >= 3)
        check_estimates(press, received.reports, restarts)
        run("systemctl", "restart", press.unit)
        first = received.reports[-1].sequence or 0
        reports = received.wait_for(lambda reports: (reports[-1].sequence or 0) > first + 1000)
        holds_truth(reports[-1])
        assert limits_in(reports[-1].events) == limits_in(before.events) != set()
        received.wait_for_good(3)
    finally:
        FILLER.unlink()
    warnings = run("journalctl", "--unit", press.unit, f"--since={begun}", "--priority=warning", "--output=cat")
    about_disk = [line for line in warnings.splitlines() if "disk" in line or "space" in line]
    print("\n".join(about_disk))
    assert 0 < len(about_disk) <= MAX_WARNINGS
    published = {report.sequence for report in reports if (report.sequence or 0) > first}
    deadline = time.monotonic() + PATIENCE
    while not published <= {report.sequence for report in press.reports(first)}:
        assert time.monotonic() < deadline, press.log()
        time.sleep(0.5)
    while not any(path.stat().st_mtime > FILLER.parent.stat().st_mtime for path in press.state.rglob("*.rrd")):
        assert time.monotonic() < deadline, press.log()
        time.sleep(0.5)
    received.close()
