"""The contract of every driver, as checks that run over any driver: built-in ones and those of other packages.

    @pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
    def test_my_driver_keeps_the_contract(check):
        with my_rig() as rig:
            check(rig)

Each check takes a rig with a driver that is not open, opens and closes it, and raises ``AssertionError`` with the
violated rule. A driver that shares connections has further checks, ``SHARING``, which take a rig of several drivers.
See docs/your-own-driver.md.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

from otolith_drivers.base import Driver, Sample, Sampling, sampling_of

MIN_SAMPLES = 30  # per check; engineering choice
SAMPLES_TIMEOUT = 10.0  # s for these samples to arrive; engineering choice, for a busy computer
CLOSE_TIMEOUT = 1.0  # s; what the driver interface asks for
STAMP_TOLERANCE = 0.1  # s before open() that a time may lie, as sources stamp with another clock
PROTOCOL = {"open", "close", "counters", "link", "describe", "sampling"}


@dataclass(frozen=True)
class Rig:
    """A driver that is not open, and a real source for it."""

    driver: Driver
    expected: Mapping[str, float]  # The value of each signal, in the unit that the setup asks for
    emit: Callable[[], None] = field(default=lambda: None)  # Makes the source send the values once, if it must be asked


def samples_have_the_wanted_unit_and_time(rig: Rig) -> None:
    """Samples have the daemon's names and units, and a recent time on the monotonic clock."""
    begun = time.monotonic()
    samples = _collect(rig)
    now = time.monotonic()
    names = {sample.signal for sample in samples}
    _require(names == set(rig.expected), f"samples of {sorted(names)}, expected {sorted(rig.expected)}")
    for sample in samples:
        value, age = rig.expected[sample.signal], now - sample.time
        close = math.isclose(sample.value, value, rel_tol=1e-4, abs_tol=1e-6)
        _require(close, f"{sample.signal} is {sample.value}, expected {value}")
        recent = begun - STAMP_TOLERANCE <= sample.time <= now
        _require(recent, f"{sample.signal} has a time {age:.3f} s ago, expected 0 to {now - begun:.3f} s")


def times_never_decrease(rig: Rig) -> None:
    """No sample of a signal is older than the previous one."""
    latest: dict[str, float] = {}
    for sample in _collect(rig):
        _require(sample.time >= latest.get(sample.signal, -math.inf), f"{sample.signal} goes back in time")
        latest[sample.signal] = sample.time


def samples_are_counted(rig: Rig) -> None:
    """Every delivered sample is counted as received, and none of a healthy source as bad."""
    samples = _collect(rig)
    counters = rig.driver.counters()
    _require(counters.received >= len(samples), f"{counters.received} counted, {len(samples)} delivered")
    _require(counters.bad == 0, f"{counters.bad} bad samples from a healthy source")


def deliver_never_gets_an_empty_list(rig: Rig) -> None:
    """``deliver`` is never called with an empty list."""
    sizes: list[int] = []
    with _opened(rig, lambda samples: sizes.append(len(samples))):
        pass
    _require(0 not in sizes, f"deliver was called with an empty list {sizes.count(0)} times")


def link_is_up_while_samples_arrive(rig: Rig) -> None:
    """The link is down with a reason before the driver is opened, and up while samples arrive."""
    before = rig.driver.link()
    _require(not before.up and bool(before.reason), "before it is opened, the link must be down with a reason")
    with _opened(rig):
        _require(rig.driver.link().up, f"samples arrive, but the link is down: {rig.driver.link().reason}")


def close_ends_everything_within_a_second(rig: Rig) -> None:
    """After close, which may be called twice, no thread or descriptor is left and no sample is delivered."""
    descriptors = _descriptors()
    with _started_threads() as threads, _opened(rig) as samples:
        begun = time.monotonic()
        rig.driver.close()
        rig.driver.close()
        _require(time.monotonic() - begun < CLOSE_TIMEOUT, f"closing took {time.monotonic() - begun:.2f} s")
    left = [thread.name for thread in threads if thread.is_alive()]
    _require(not left, f"threads left: {', '.join(left)}")
    while left_open := _descriptors() - descriptors:  # a source in this process closes its end later
        in_time = time.monotonic() - begun < CLOSE_TIMEOUT
        _require(in_time, f"descriptors left open: {', '.join(sorted(left_open))}")
        time.sleep(0.005)
    delivered = len(samples)
    rig.emit()
    time.sleep(0.05)  # long enough for a sample to arrive
    _require(len(samples) == delivered, "samples were delivered after close")


def description_names_all_signals(rig: Rig) -> None:
    """The description names each signal before the driver is opened."""
    text = "\n".join(rig.driver.describe())
    for name in rig.expected:
        _require(name in text, f"{name} is not in the description")


def public_names_are_those_of_the_protocol(rig: Rig) -> None:
    """The driver has no public name beside the protocol's, none of which writes to the machine."""
    public = {name for name in dir(rig.driver) if not name.startswith("_")}
    _require(public == PROTOCOL, f"public names that differ from the protocol: {sorted(public ^ PROTOCOL)}")
    kinds = {sampling_of(rig.driver.sampling, signal) for signal in rig.expected}
    _require(kinds <= set(Sampling), "sampling must be one of otolith_drivers.base.Sampling, or one for each signal")


CONTRACT: tuple[Callable[[Rig], None], ...] = (
    samples_have_the_wanted_unit_and_time,
    times_never_decrease,
    samples_are_counted,
    deliver_never_gets_an_empty_list,
    link_is_up_while_samples_arrive,
    close_ends_everything_within_a_second,
    description_names_all_signals,
    public_names_are_those_of_the_protocol,
)


@dataclass(frozen=True)
class SharedRig:
    """Drivers of several machines at one place, none of them open, as a driver sees them that shares connections."""

    rigs: Sequence[Rig]
    connections: Callable[[], int]  # How many there are now, as the other end or the operating system counts them


def machines_at_a_place_have_one_connection(rig: SharedRig) -> None:
    """There is one connection while any driver is open, each gets what is its own, and the last one closes it."""
    before = rig.connections()
    with ExitStack() as stack:
        opened = [stack.enter_context(_opened(each)) for each in rig.rigs]
        _require(rig.connections() - before == 1, f"{rig.connections() - before} connections instead of 1")
        for each, samples in zip(rig.rigs, opened, strict=True):
            wrong = {sample.signal for sample in samples} - set(each.expected)
            _require(not wrong, f"samples of another machine: {sorted(wrong)}")
            values = {
                sample.value for sample in samples if not math.isclose(sample.value, each.expected[sample.signal])
            }
            _require(not values, f"values of another machine: {sorted(values)[:5]}")
            _require(_harm(each) == (0, 0), f"bad samples and reconnections of a healthy machine: {_harm(each)}")
    _wait(lambda: rig.connections() == before, "the connection is open after the last driver has closed")


def one_that_comes_or_leaves_disturbs_no_other(rig: SharedRig) -> None:
    """While others open and close, the samples of a machine go on, and no reconnection is counted."""
    staying, *others = rig.rigs
    with _opened(staying) as samples:
        for other in others:
            with _opened(other):
                pass
            _go_on(staying, samples, f"after {other.driver.describe()[0]!r} has closed")
        _require(_harm(staying) == (0, 0), f"bad samples and reconnections of one that stayed: {_harm(staying)}")


def one_whose_samples_are_refused_harms_no_other(rig: SharedRig) -> None:
    """What delivering to one machine raises reaches no other one, and is a defect of that one alone."""
    hostile, *others = rig.rigs

    def refuse(_: Sequence[Sample]) -> None:
        raise ArithmeticError("no room")

    hostile.driver.open(refuse)
    try:
        with ExitStack() as stack:
            for other in others:
                samples = stack.enter_context(_opened(other))
                for _ in range(3):
                    hostile.emit()
                _go_on(other, samples, "while another machine refuses its own")
                _require(_harm(other) == (0, 0), f"bad samples and reconnections: {_harm(other)}")
                _require(not other.driver.link().defect, f"the defect of another machine: {other.driver.link().defect}")
            _wait(lambda: bool(hostile.driver.link().defect), "the machine that refuses its samples has no defect")
    finally:
        hostile.driver.close()


SHARING: tuple[Callable[[SharedRig], None], ...] = (
    machines_at_a_place_have_one_connection,
    one_that_comes_or_leaves_disturbs_no_other,
    one_whose_samples_are_refused_harms_no_other,
)


def _harm(rig: Rig) -> tuple[int, int]:
    """Return bad samples and reconnections; a busy computer also loses samples."""
    counters = rig.driver.counters()
    return counters.bad, counters.reconnects


def _go_on(rig: Rig, samples: Sequence[Sample], when: str) -> None:
    """Require that samples come that have not come yet."""
    before = len(samples)

    def came() -> bool:
        rig.emit()
        return len(samples) >= before + 3

    _wait(came, f"no samples {when}: {rig.driver.link()}")


def _wait(condition: Callable[[], bool], rule: str) -> None:
    deadline = time.monotonic() + SAMPLES_TIMEOUT
    while not condition():
        _require(time.monotonic() < deadline, rule)
        time.sleep(0.005)


@contextmanager
def _opened(rig: Rig, observe: Callable[[Sequence[Sample]], None] = lambda _: None) -> Iterator[list[Sample]]:
    """Open the driver, wait for enough samples of all signals, and close it at the end."""
    samples: list[Sample] = []

    def deliver(new: Sequence[Sample]) -> None:
        observe(new)
        samples.extend(new)

    rig.driver.open(deliver)
    try:
        deadline = time.monotonic() + SAMPLES_TIMEOUT
        while len(samples) < MIN_SAMPLES or {sample.signal for sample in samples} < set(rig.expected):
            in_time = time.monotonic() < deadline
            _require(in_time, f"{len(samples)} samples in {SAMPLES_TIMEOUT:g} s: {rig.driver.link()}")
            rig.emit()
            time.sleep(0.005)
        yield samples
    finally:
        rig.driver.close()


def _collect(rig: Rig) -> list[Sample]:
    with _opened(rig) as samples:
        pass
    return samples


@contextmanager
def _started_threads() -> Iterator[set[threading.Thread]]:
    """Yield the threads that the driver starts. Those that ran before are of the source, with those that they start."""
    of_source, of_driver = set(threading.enumerate()) - {threading.current_thread()}, set[threading.Thread]()
    start = threading.Thread.start

    def start_and_note(thread: threading.Thread) -> None:
        (of_source if threading.current_thread() in of_source else of_driver).add(thread)
        start(thread)

    with mock.patch.object(threading.Thread, "start", start_and_note):
        yield of_driver


def _descriptors() -> set[str]:
    """Return number and target of each open descriptor of this process, like ``7 socket:[4711]``."""
    targets = set()
    for link in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # the descriptor of this listing is closed meanwhile
            targets.add(f"{link.name} {link.readlink()}")
    return targets


def _require(condition: bool, rule: str) -> None:
    if not condition:
        raise AssertionError(rule)
