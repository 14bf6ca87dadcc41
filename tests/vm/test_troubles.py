"""What an installed service does in trouble: a full disk, a wrong clock, stopped processes. In the guest, as root."""

import os
import signal
import time
from contextlib import closing
from pathlib import Path

from otolith.health.schema import EventDocument, ReportDocument, Status
from tests.vm.conftest import PATIENCE, ReportListener, Reports, counters, good, run
from tests.vm.service import Instance, holds_truth

YEAR = 365.25 * 86_400.0  # s
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


def check_kept(press: Instance, received: ReportListener, first: int) -> None:
    """What was published after number ``first``, while nothing could be written, is in the history now."""
    published = {report.sequence for report in received.reports if (report.sequence or 0) > first}
    deadline = time.monotonic() + PATIENCE
    while not published <= {report.sequence for report in press.reports(first)}:
        assert time.monotonic() < deadline, press.log()
        time.sleep(0.5)


def fill_disk() -> None:
    """Leave no byte of the disk to users other than root; the recorder deletes files to make room, so do it again."""
    with FILLER.open("ab") as file:
        size = file.tell()
        while (status := os.statvfs(FILLER)).f_bavail:
            length = status.f_bavail * status.f_frsize
            os.posix_fallocate(file.fileno(), size, length)
            size += length


def about_disk(press: Instance, begun: str) -> list[str]:
    """Warnings about the disk that it has logged since ``begun``."""
    text = run("journalctl", "--unit", press.unit, f"--since={begun}", "--priority=warning", "--output=cat")
    return [line for line in text.splitlines() if "disk" in line or "space" in line]


def test_processes_that_are_stopped_are_replaced(press: Instance) -> None:
    """Worker and recorder: no signal says that a process does nothing any more."""
    main, restarts = press.shown("MainPID"), press.shown("NRestarts")
    before = counters([press.last()])
    for child in Path(f"/proc/{main}/task/{main}/children").read_text(encoding="ascii").split():
        if b"resource_tracker" not in Path(f"/proc/{child}/cmdline").read_bytes():
            os.kill(int(child), signal.SIGSTOP)
    deadline = time.monotonic() + PATIENCE
    while (after := counters([press.last()])).worker_restarts == before.worker_restarts or (
        after.recorder_restarts == before.recorder_restarts
    ):
        assert time.monotonic() < deadline, press.log()
        time.sleep(0.5)
    last = press.last().sequence or 0
    check_estimates(press, press.wait_for_reports(2, after=last), restarts)


def test_a_clock_that_is_a_year_off_costs_nothing(press: Instance) -> None:
    before, restarts = press.last(), press.shown("NRestarts")
    for shift in (YEAR, -2.0 * YEAR, YEAR):
        last = press.last().sequence or 0
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
    before, restarts = press.last(), press.shown("NRestarts")
    begun = run("date", "+%F %T").strip()

    def is_refused(reports: Reports) -> bool:
        fill_disk()
        return len(good(reports)) >= 3 and bool(about_disk(press, begun))

    def is_restarted(reports: Reports) -> bool:
        fill_disk()
        return (reports[-1].sequence or 0) > ended

    with closing(listener(press)) as received:
        try:
            received.wait_for(is_refused)
            check_estimates(press, received.reports, restarts)
            run("systemctl", "restart", press.unit)
            ended = (received.reports[-1].sequence or 0) + 1000  # above what the one that ended could not write
            reports = received.wait_for(is_restarted)
            holds_truth(reports[-1])
            assert limits_in(reports[-1].events) == limits_in(before.events) != set()
            received.wait_for_good(3)
        finally:
            FILLER.unlink()
        print("\n".join(warnings := about_disk(press, begun)))
        assert len(warnings) <= MAX_WARNINGS
        check_kept(press, received, ended)
    deadline = time.monotonic() + PATIENCE
    while not any(path.stat().st_mtime > FILLER.parent.stat().st_mtime for path in press.state.rglob("*.rrd")):
        assert time.monotonic() < deadline, press.log()
        time.sleep(0.5)


def test_a_disk_that_turns_read_only_costs_no_monitoring(press: Instance) -> None:
    """As Linux makes it after an error of the disk; the key is that of an emergency."""
    restarts = press.shown("NRestarts")
    with closing(listener(press)) as received:
        first = received.wait_for(bool)[-1].sequence or 0
        Path("/proc/sysrq-trigger").write_text("u", encoding="ascii")
        try:
            while not os.statvfs(press.state).f_flag & os.ST_RDONLY:
                time.sleep(0.1)
            seen = len(good(received.reports))
            reports = received.wait_for(lambda reports: len(good(reports)) >= seen + 5)
            check_estimates(press, reports, restarts)
        finally:
            run("mount", "-o", "remount,rw", "/")
        check_kept(press, received, first)
    assert press.shown("NRestarts") == restarts
