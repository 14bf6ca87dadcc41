"""Whatever the wall clock does, no window is affected: values, intervals, onsets and the history are right."""

import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import pytest
from benchmarks.discovery.motor import PERIOD, R_A, Faults, simulate_motor
from click.testing import CliRunner

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, ComponentRecord, OperatorDecisions, restore_components
from otolith.cli.main import cli
from otolith.discovery.decision import AdoptedComponent
from otolith.estimation.imm_filter import UNKNOWN_AWAY
from otolith.estimation.problem import Component
from otolith.health.labels import TimeLabels
from otolith.health.prognosis import History
from otolith.health.schema import EventChange, EventDocument, ReportDocument
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.clock import LABEL_TOLERANCE, MAX_AWAY, MIN_SET, ClockReading, ServiceClock
from otolith.runtime.service import Service
from otolith.storage.history import WINDOW, HistoryReader
from otolith.storage.learned_state import SavedClock
from otolith_drivers.common.clocks import clock_difference, wall_clock_offset
from otolith_drivers.user_dirs import state_directory
from tests.conftest import EXAMPLES
from tests.runtime.motors import RECORDS, windows
from tests.variants import often

NOW = 1_795_000_000.0  # Unix s
LENGTH = RECORDS * PERIOD
HOUR, DAY, YEAR = 3600.0, 86_400.0, 365 * 86_400.0  # s
HEALTHY, FAULTY = 6, 8  # windows, one after the other, and healthy again after them
COUNT = 2 * HEALTHY + FAULTY
RESISTANCE = 0.9 * R_A  # ohm, of the faulty motor


@dataclass
class Computer:
    """The clocks of a computer: ``error`` is by how much its wall clock is ahead of the time (s)."""

    error: float = 0.0
    boot: str = "first"
    time: float = NOW  # Unix s
    booted: float = NOW - 2.0 * HOUR
    suspended: float = 0.0  # s since the boot

    def read(self) -> ClockReading:
        uptime = self.time - self.booted
        return ClockReading(self.boot, uptime, uptime - self.suspended, self.time + self.error)

    def reboot(self, away: float, error: float = 0.0) -> None:
        """Be off for ``away`` s."""
        self.time += away
        self.boot, self.booted, self.suspended, self.error = f"boot at {self.time}", self.time - 20.0, 0.0, error


@lru_cache
def records() -> np.ndarray:
    """A motor whose resistance is too small for a while."""
    parts = ((HEALTHY, R_A), (FAULTY, RESISTANCE), (HEALTHY, R_A))
    simulated = (simulate_motor("sweep", LENGTH * n, Faults(resistance=r), seed=n) for n, r in parts)
    return np.concatenate(list(simulated))


@dataclass
class Daemons:
    """The daemons of a machine, one after the other, on a computer whose clocks the test sets.

    Real service, core, state and history; windows come from a simulation instead of a bus, and worker and publisher do
    not run.
    """

    machine: LoadedMachine
    computer: Computer
    published: list[ReportDocument] = field(default_factory=list)
    cut: list[Window] = field(default_factory=list)
    window: int = 0
    certificate: None = None

    def __post_init__(self) -> None:
        self.service = self._started()

    def _started(self) -> Service:
        service = Service(self.machine, clocks=self.computer.read)
        service._start_clock()
        service.machine.state = service._restored(service.machine.state)
        service._start_history()
        service.publisher = self  # type: ignore[assignment]
        return service

    def publish(self, document: ReportDocument, text: str) -> None:
        """Keep what the daemon publishes, whose JSON is that of the report."""
        assert text == document.to_json()
        self.published.append(document)

    def warn_of_expiry(self, _: object) -> None:
        """Nothing expires."""

    def warning(self, _: object) -> str:
        """Nothing expires."""
        return ""

    def expiry_notice(self, _: object) -> None:
        """Nothing expires."""

    def run(self, count: int = 1) -> None:
        """Monitor for ``count`` windows."""
        service = self.service
        for _ in range(count):
            self.computer.time += LENGTH
            service._follow_wall_clock()
            start = self.computer.read().monotonic - LENGTH + service._clock.offset
            (window,) = windows(records()[self.window * RECORDS : (self.window + 1) * RECORDS], start)
            self.cut.append(replace(window, index=len(self.cut), ahead=service._clock.ahead))
            state, report = adapt(service.machine.state, self.cut[-1])
            service.machine.state = state
            service._unsaved = service.machine.packed
            service.machine.windows += 1
            service._publish(report, 0.1)
            self.window += 1

    @property
    def reader(self) -> HistoryReader:
        """The history of the machine."""
        assert self.service._history is not None
        return self.service._history.reader

    def history_of_values(self) -> History:
        """From which the resistance is forecast."""
        return self.service.machine.state.health.histories["R_a"]

    def stop(self) -> None:
        """Stop the daemon: it saves its state and writes its history."""
        assert self.service._history is not None
        self.service._store.save(self.service.machine.state)
        self.service._history.stop(10.0)
        self.service._store.unlock()

    def restart(self) -> None:
        """Stop the daemon and start the next one."""
        self.stop()
        self.service = self._started()


@pytest.fixture
def daemons() -> Callable[[Computer], Daemons]:
    """Function that starts the daemon of a motor on a computer."""
    machine = load_machine(EXAMPLES / "dc-motor-in-process.toml")
    return lambda computer: Daemons(machine, computer)


Start = Callable[[Computer], Daemons]


@dataclass(frozen=True)
class Case:
    """A row of the table of clocks in docs/service.md."""

    first: float  # Error of the wall clock at the start, s
    then: dict[int, float] = field(default_factory=dict)  # Error from a window on, s
    per_window: float = 0.0  # By how much the error grows with each window, s
    events: tuple[float, ...] = ()  # By how much the clock was set, s, as events tell
    uptime: float = 2.0 * HOUR  # At the start, s


WRONG, RIGHT = 10, 13  # windows with an open event from which on the wall clock is wrong, and right again
OFTEN = ("1970, then right", "+1 h, then right", "set while the event is cleared", "a drift of 100 ppm")
CASES = {
    "right": Case(0.0),
    "boots in 1970, then right": Case(-NOW, {WRONG: 0.0}, uptime=20.0),
    "boots a year behind, then right": Case(-YEAR, {WRONG: 0.0}, uptime=20.0),
    "boots a year ahead, then right": Case(YEAR, {WRONG: 0.0}, uptime=20.0),
    "boots a night behind, then right": Case(-0.5 * DAY, {WRONG: 0.0}, uptime=20.0),
    "1970, right after hours": Case(-NOW, {WRONG: 0.0}, events=(NOW,)),
    "a year back, then right": Case(0.0, {WRONG: -YEAR, RIGHT: 0.0}, events=(-YEAR, YEAR)),
    "+1 h, then right": Case(0.0, {WRONG: HOUR, RIGHT: 0.0}, events=(HOUR, -HOUR)),
    "-1 h, then right": Case(0.0, {WRONG: -HOUR, RIGHT: 0.0}, events=(-HOUR, HOUR)),
    "a leap of 60 s, then right": Case(0.0, {WRONG: 60.0, RIGHT: 0.0}, events=(60.0, -60.0)),
    "set while the event is cleared": Case(0.0, {16: -9000 * DAY, 18: 0.0}, events=(-9000 * DAY, 9000 * DAY)),
    "a drift of 100 ppm": Case(0.0, per_window=1e-4 * LENGTH),
    "a day of that drift in each window": Case(0.0, per_window=1e-4 * DAY),
    "slewed at 500 ppm": Case(0.5 * MIN_SET, per_window=-5e-4 * LENGTH),
}


def values(reports: Sequence[ReportDocument]) -> list[float]:
    """Value and interval of the resistance in each report."""
    shown = [report.parameters["R_a"] for report in reports]
    return [number for item in shown for number in (item.value, item.low, item.high) if number is not None]


def of_limit(events: Sequence[EventDocument]) -> list[EventDocument]:
    return [event for event in events if event.id.startswith("limit/")]


@pytest.mark.parametrize("name", often(OFTEN, CASES))
def test_no_window_is_affected_by_the_wall_clock(name: str, daemons: Start) -> None:
    """The table of clocks in docs/service.md: value, interval, onset and history."""
    case, right = CASES[name], daemons(Computer())
    right.run(COUNT)
    right.stop()
    true_raised, true_cleared = of_limit(right.reader.events(0.0))
    true_times = [row.time for row in right.reader.samples(WINDOW, 0.0, ["R_a"])]
    shutil.rmtree(state_directory())
    computer = Computer(error=case.first, booted=NOW - case.uptime)
    running = daemons(computer)
    for index in range(COUNT):
        computer.error = case.then.get(index, computer.error + case.per_window)
        running.run()
    running.stop()
    pauses = np.diff([window.start for window in running.cut])
    assert pauses == pytest.approx(LENGTH, abs=1e-6)  # on the clock of the filter
    assert values(running.published) == pytest.approx(values(right.published), rel=1e-6)
    assert len(values(right.published)) == 3 * COUNT
    assert len(running.history_of_values()) == len(right.history_of_values()) > 0

    reader = running.reader
    raised, cleared = of_limit(reader.events(0.0))
    tolerance = LABEL_TOLERANCE + abs(case.first if not case.then else 0.0) + abs(case.per_window) * COUNT
    assert (raised.change, cleared.change) == (EventChange.RAISED, EventChange.CLEARED)
    for event, true in ((raised, true_raised), (cleared, true_cleared)):
        assert event.start == pytest.approx(true.start, abs=tolerance)
    assert cleared.end == pytest.approx(true_cleared.end, abs=tolerance)
    last = of_limit(running.published[16].events)[0]
    assert last.id == raised.id  # it is the same event, whatever its begin is called
    samples = reader.samples(WINDOW, 0.0, ["R_a"])
    assert [row.time for row in samples] == pytest.approx(true_times, abs=tolerance)
    assert len(samples) == COUNT
    ends = [report.window.end for report in reversed(reader.latest(COUNT))]
    assert ends == pytest.approx(true_times, abs=tolerance)

    noted = [event for event in reader.events(0.0) if event.change is EventChange.NOTED]
    assert [event.evidence.value for event in noted] == pytest.approx(case.events, abs=1e-3)
    assert all(event.end == event.start for event in noted)
    sequences = [report.sequence or 0 for report in running.published]
    assert sequences == sorted(sequences)


def test_published_times_are_those_of_the_wall_clock(daemons: Start) -> None:
    """Whoever compares a report with his own watch is on the same computer: it has the same wrong clock."""
    computer = Computer(error=-NOW)
    running = daemons(computer)
    running.run(3)
    assert running.published[-1].window.end == pytest.approx(computer.read().unix, abs=1e-6)
    computer.error = 0.0
    running.run(1)
    assert running.published[-1].window.end == pytest.approx(computer.time, abs=1e-6)
    assert (running.published[-1].cost.latency_s or 0.0) < 1e-6
    running.stop()


def test_a_boot_with_a_wrong_clock_keeps_the_begin_of_an_open_event(daemons: Start) -> None:
    computer = Computer()
    running = daemons(computer)
    running.run(12)
    (before,) = of_limit(running.published[-1].events)
    running.stop()
    computer.reboot(away=60.0, error=-9000 * DAY)
    running.service = running._started()
    running.run(1)
    (at_once,) = of_limit(running.published[-1].events)
    assert (at_once.id, at_once.start, at_once.since) == (before.id, before.start, before.since)
    running.run(4)  # the motor is repaired, and the event cleared
    cleared = of_limit(running.published[-1].events)
    running.run(1)
    cleared = cleared or of_limit(running.published[-1].events)
    computer.error = 0.0
    running.run(1)
    running.stop()
    first, last = of_limit(running.reader.events(computer.time - HOUR))
    assert (first.start, last.start) == (before.start, before.start)
    assert last.end == pytest.approx(computer.time - 3 * LENGTH, abs=3 * LENGTH)
    assert cleared


def with_component(state: AdaptationState, onset: float) -> AdaptationState:
    """The state with an additional torque that was found at a time of the windows."""
    adopted = AdoptedComponent(Component("shaft", "constant", "", 0.004), onset)
    return restore_components(state, (ComponentRecord(adopted, (0.004,), (1e-4,)),))


@pytest.mark.parametrize("is_forgotten", [True, False])
@pytest.mark.parametrize("error", [YEAR, -YEAR])
def test_a_component_is_forgotten_if_it_was_found_before_the_operator_said_so(
    error: float, is_forgotten: bool, daemons: Start
) -> None:
    """The first daemon began with a wrong clock, so its windows have other times than the operator."""
    computer = Computer(error=error)
    running = daemons(computer)
    computer.error = 0.0
    running.service._follow_wall_clock()
    machine, found = running.service.machine, computer.time
    machine.state = with_component(machine.state, running.service._clock.now())
    running.run(1)
    (key,) = {known.component.key for known in machine.state.adopted}
    moment = found + 60.0 if is_forgotten else found - 60.0
    running.service._store.operator.write(OperatorDecisions(forgotten={key: moment}))
    running.stop()
    arguments = ["components", "list", str(running.machine.path)]
    shown = [
        CliRunner().invoke(cli, [*arguments, *options], standalone_mode=False, catch_exceptions=False).stdout
        for options in ([], ["--json"])
    ]
    assert ("forgotten" in shown[0]) == is_forgotten
    assert json.loads(shown[1])["components"][0]["adopted"]["onset"] == pytest.approx(found, abs=LABEL_TOLERANCE)
    computer.time += 120.0
    running.service = running._started()
    adopted = running.service.machine.state.adopted
    assert [known.component.key for known in adopted] == ([] if is_forgotten else [key])
    running.stop()


@pytest.mark.parametrize("error", [-NOW, HOUR, -YEAR])
def test_a_daemon_that_starts_again_knows_how_long_it_was_away_whatever_set_the_clock(
    error: float, daemons: Start
) -> None:
    computer = Computer()
    running = daemons(computer)
    running.run(5)
    running.stop()
    computer.time += 7.0
    computer.error = error
    running.service = running._started()
    running.run(1)
    assert np.diff([window.start for window in running.cut[-2:]]) == pytest.approx(7.0 + LENGTH, abs=1e-6)
    (event,) = running.published[-1].events
    assert event.evidence.value == pytest.approx(error, abs=1e-3)
    running.stop()


@pytest.mark.parametrize(
    ("away", "error", "counts"),
    [
        (600.0, 0.0, 600.0),
        (600.0, -NOW, UNKNOWN_AWAY),
        (600.0, -HOUR, UNKNOWN_AWAY),
        (600.0, HOUR, HOUR + 600.0),
        (600.0, 30.0 * YEAR, UNKNOWN_AWAY),
        (10.0 * DAY, 0.0, 10.0 * DAY),
    ],
    ids=["right", "1970", "an hour behind", "an hour ahead", "30 years ahead", "ten days"],
)
def test_the_time_over_a_reboot_is_that_of_the_wall_clock_unless_it_is_impossible(
    away: float, error: float, counts: float
) -> None:
    computer = Computer()
    clock = ServiceClock(read=computer.read)
    end = clock.now()
    computer.reboot(away, error)
    again = ServiceClock(clock.saved, end, read=computer.read)
    assert again.now() - end == pytest.approx(counts, abs=1e-6)
    assert again.labels.unix(again.now()) == pytest.approx(computer.read().unix, abs=1e-6)
    computer.time, computer.error = computer.time + 60.0, 0.0
    again.update()
    assert again.now() - end == pytest.approx(counts + 60.0, abs=1e-6)
    assert again.labels.unix(again.now()) == pytest.approx(computer.time, abs=LABEL_TOLERANCE)
    assert again.labels.unix(end) == pytest.approx(end)


def test_a_suspension_elapses_and_is_no_step_of_the_wall_clock() -> None:
    computer = Computer()
    clock = ServiceClock(read=computer.read)
    before, monotonic = clock.offset, computer.read().monotonic
    computer.time, computer.suspended = computer.time + HOUR, HOUR
    assert clock.update() is None
    assert clock.offset - before == pytest.approx(HOUR)
    assert computer.read().monotonic == pytest.approx(monotonic)


def test_a_computer_that_does_not_tell_its_boot_counts_by_the_wall_clock() -> None:
    computer = Computer(boot="")
    clock = ServiceClock(read=computer.read)
    end, saved = clock.now(), clock.saved
    computer.time, computer.error = computer.time + 60.0, 600.0
    assert ServiceClock(saved, end, read=computer.read).now() - end == pytest.approx(660.0)


def test_without_a_saved_clock_time_goes_on_after_the_history() -> None:
    computer = Computer(error=-NOW)
    labels = TimeLabels(((NOW - HOUR, -5.0),))
    clock = ServiceClock(None, NOW, labels, computer.read)
    assert clock.now() == pytest.approx(NOW + UNKNOWN_AWAY)
    assert clock.labels.unix(NOW - 10.0) == NOW - 15.0


def test_a_saved_clock_survives_its_file() -> None:
    clock = ServiceClock(read=Computer().read)
    clock.labels = TimeLabels(((1.0, 2.0), (3.0, -4.0)))
    assert SavedClock.model_validate_json(clock.saved.model_dump_json()) == clock.saved
    with pytest.raises(ValueError, match="rise"):
        SavedClock(boot="", offset=0.0, begin=0.0, labels=TimeLabels(((3.0, 1.0), (1.0, 2.0))))


def test_the_clocks_of_this_computer_are_read() -> None:
    clock = ServiceClock()
    assert clock.update() is None
    assert clock.offset == pytest.approx(wall_clock_offset(), abs=1.0)
    assert MIN_SET < MAX_AWAY


def test_a_thread_that_is_held_up_between_two_readings_does_not_falsify_their_difference() -> None:
    moments = iter([0.0, 100.0, 5.0, 10.0, 110.00001, 10.00002])
    readings = [next(moments) for _ in range(6)]
    other, clock = iter([readings[0], readings[2], readings[3], readings[5]]), iter([readings[1], readings[4]])
    assert clock_difference(lambda: next(clock), lambda: next(other)) == pytest.approx(100.0)
    assert math.isfinite(wall_clock_offset())
