"""The contract of every driver, as checks that run over any driver: built-in ones and those of other packages.

    @pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
    def test_my_driver_keeps_the_contract(check):
        with my_rig() as rig:
            check(rig)

Each check takes a rig with a driver that is not open, opens and closes it, and raises ``AssertionError`` with the
violated rule. See docs/your-own-driver.md.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
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
