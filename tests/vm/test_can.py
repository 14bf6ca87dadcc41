"""Our daemon on a bus of the Linux kernel, with can-utils as the other nodes. Runs in the guest, as root."""

import math
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from otolith.acquisition.window import Verdict
from otolith.health.schema import CountersDocument, ParameterDocument, ReportDocument, Status
from tests.vm.conftest import (
    CHANNEL,
    PATIENCE,
    PUNCTUALLY,
    RESISTANCE,
    Machine,
    Program,
    ReportListener,
    Reports,
    check_missed,
    counters,
    good,
    is_estimated,
    machine_on_a_bus,
    resistance,
    run,
    transmitted,
)

FRAMES = 200  # per second, of the plant
MAX_ROUNDS = 10  # in which the dump of the bus is played
OURS = ("181", "281")
WITNESS_BYTES = 8 << 20  # that the kernel keeps for candump while the computer is busy: a minute of the plant's frames


@dataclass(frozen=True)
class Live:
    """Reports of a daemon, and what candump recorded on the bus meanwhile."""

    silent: ReportDocument
    transmitted_before: int
    reports: Reports
    dump: Path
    frames: int
    """That the plant says it has sent."""
    transmitted: int
    """That were on the bus."""


@pytest.fixture(scope="module")
def live(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Live:
    with machine_on_a_bus(tmp_path_factory.mktemp("live")) as machine:
        _, listener = machine.daemon()
        before = transmitted()
        dump = machine.start("candump", "-L", "-r", str(WITNESS_BYTES), CHANNEL)
        plant = machine.plant()
        reports = listener.wait_for_good(10)
        plant.stop()
        frames = int(re.findall(r"(\d+) frames in", plant.text())[0])
        deadline = time.monotonic() + 10.0
        while len(dump.text().splitlines()) < frames and time.monotonic() < deadline:
            time.sleep(0.1)
        return Live(reports[0], before, list(reports), dump.log, frames, transmitted())


@dataclass(frozen=True)
class Watched:
    """A machine whose daemon runs, on a bus that is silent between the tests."""

    machine: Machine
    daemon: Program
    listener: ReportListener

    def now(self) -> CountersDocument:
        """What has been counted up to the end of a window that ends after this call."""
        moment = time.time()
        return counters(self.listener.wait_for(lambda reports: reports[-1].window.end >= moment))


@pytest.fixture(scope="module")
def watched(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    with machine_on_a_bus(tmp_path_factory.mktemp("watched")) as machine:
        yield Watched(machine, *machine.daemon())


@pytest.fixture
def plant(watched: Watched) -> Iterator[Program]:
    plant = watched.machine.plant()
    watched.listener.wait_for_good(2)
    yield plant
    plant.stop()


def check(found: ParameterDocument) -> None:
    assert found.status is Status.ESTIMATED
    assert found.value is not None
    assert found.sd is not None
    assert found.value == pytest.approx(RESISTANCE, rel=0.005)
    assert abs(found.value - RESISTANCE) <= 3.0 * found.sd


def test_it_estimates_what_the_bus_brings(live: Live) -> None:
    check(resistance(live.reports))
    first, last = counters(good(live.reports)[:1]), counters(live.reports)
    assert (last.bad, last.lost) == (0, 0)
    check_missed(first, last)
    assert last.reconnects == first.reconnects  # a bus that is silent for long is opened anew


def test_it_never_sends(live: Live) -> None:
    """Every frame that the kernel has seen on this bus is one of the plant, and another's dump has just those."""
    assert live.silent.window.quality.verdict is Verdict.BAD
    assert live.transmitted_before == 0
    assert live.transmitted == live.frames > 0
    lines = live.dump.read_text(encoding="ascii").splitlines()
    assert len(lines) == live.frames
    assert {line.split()[2].split("#")[0] for line in lines} == set(OURS)


def test_a_replayed_dump_says_what_the_live_bus_said(
    compiled: None, live: Live, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """It is played until five whole windows were estimated: a worker that is behind, as it starts, misses some."""
    with machine_on_a_bus(tmp_path_factory.mktemp("replayed")) as machine:
        _, listener = machine.daemon()
        rounds, whole = 0, Reports()
        while len(whole) < 5:
            assert rounds < MAX_ROUNDS, [str(report.window.quality) for report in listener.reports]
            rounds += 1
            player = machine.start(*PUNCTUALLY, "canplayer", "-I", str(live.dump))
            assert player.process.wait(timeout=PATIENCE) == 0
            reports = listener.wait_for_window()  # no window has the end of the dump and its begin
            whole = [report for report in filter(is_estimated, good(reports)) if not report.window.quality.missing]
        assert transmitted() == rounds * live.frames
    found, then = resistance(whole), resistance(live.reports)
    check(found)
    assert found.value is not None
    assert found.sd is not None
    assert then.value is not None
    assert then.sd is not None
    assert abs(found.value - then.value) <= 3.0 * math.hypot(found.sd, then.sd)


def test_a_flood_of_other_frames_changes_nothing(watched: Watched, plant: Program) -> None:
    """Extended, FD and remote frames, also with our identifiers, and error frames."""
    machine, listener = watched.machine, watched.listener
    before, sent = watched.now(), transmitted()
    kinds = [
        ["-e", "-I", "r"],
        ["-e", "-I", OURS[0]],
        ["-f", "-I", OURS[0]],
        ["-f", "-b", "-E", "-I", OURS[1]],
        ["-R", "-I", OURS[0]],
        ["-m", "-I", "7FF"],
    ]
    begun = time.monotonic()
    flood = [machine.start("cangen", CHANNEL, "-g", "5", "-i", *kind) for kind in kinds]
    for error_class in ("20000004", "20000040", "20000080"):
        run("cansend", CHANNEL, f"{error_class}#0000000000000000")
    reports = listener.wait_for_good(6)
    seconds = time.monotonic() - begun
    others = transmitted() - sent - FRAMES * seconds
    assert [generator.process.poll() for generator in flood] == [None] * len(flood)
    for generator in flood:
        generator.stop()
    print(f"{others / seconds:.0f} other frames per second")
    assert others > 1000
    check(resistance(reports))
    last = counters(reports)
    assert (last.bad, last.lost, last.reconnects) == (before.bad, before.lost, before.reconnects)
    check_missed(before, last)
    warnings = {line for report in reports if report.driver is not None for line in report.driver.warnings}
    assert any("3 error frames" in line for line in warnings)  # of a while ago, on a busy computer


def test_short_frames_of_our_own_identifiers_are_counted(watched: Watched, plant: Program) -> None:
    """Each of them lacks one or both of its signals, which end with the fourth byte."""
    before = watched.now()
    short = [f"{identifier}#{'00' * length}" for identifier in OURS for length in range(4)]
    for frame in short:
        run("cansend", CHANNEL, frame)
    watched.listener.wait_for(lambda reports: counters(reports).bad >= before.bad + len(short))
    assert watched.now().bad == before.bad + len(short)
    check(resistance(watched.listener.wait_for_good(4)))  # the first ones have the zeros of what was in the frames


@pytest.mark.parametrize("how", ["down", "gone"])
def test_it_lives_through_an_outage_of_the_bus(live: Live, watched: Watched, plant: Program, how: str) -> None:
    """The interface is set down, as for a new bit rate, or taken away, as an adapter is unplugged."""
    listener, before = watched.listener, watched.now()
    run(*("ip", "link", "set", CHANNEL, "down") if how == "down" else ("ip", "link", "delete", CHANNEL))
    assert plant.process.wait(timeout=20) == 2
    assert "sending on the bus failed" in plant.text()
    moment = time.time()
    reports = listener.wait_for(lambda reports: sum(report.window.start >= moment for report in reports) >= 5)
    quality = reports[-1].window.quality
    assert quality.verdict is Verdict.BAD
    assert any("no samples of" in reason for reason in quality.reasons)
    assert resistance(reports).status is Status.HELD
    assert counters(reports).windows_bad >= before.windows_bad + 4
    driver = reports[-1].driver
    assert driver is not None
    assert not driver.up
    assert {"down": "Network is down", "gone": "No such device"}[how] in driver.reason

    if how == "gone":
        run("ip", "link", "add", CHANNEL, "type", "vcan")
    run("ip", "link", "set", CHANNEL, "up")
    player = watched.machine.start(*PUNCTUALLY, "canplayer", "-I", str(live.dump))
    begun, seen = time.time(), len(good(reports))
    reports = listener.wait_for_good(2)
    first = good(reports)[seen]
    print(f"{how}: the first good window begins {first.window.start - begun:.2f} s after the bus came back")
    check(resistance(reports))
    assert counters(reports).reconnects == before.reconnects + 1
    player.stop()
