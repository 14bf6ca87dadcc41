"""What every driver promises, as checks that can be run over any driver: ours and other people's.

    @pytest.mark.parametrize("promise", CONTRACT, ids=lambda promise: promise.__name__)
    def test_my_driver_keeps_the_contract(promise):
        with my_rig() as rig:
            promise(rig)

Each check takes a rig with a driver that has not been opened, opens and closes it, and raises ``AssertionError`` with
what was promised. See docs/your-own-driver.md.
"""

import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from otolith_drivers.base import Driver, Sample, Sampling

ENOUGH = 30  # samples
PATIENCE = 10.0  # s until they must have come
STOPS_WITHIN = 1.0  # s
VERBS = {"open", "close", "counters", "link", "describe", "sampling"}


@dataclass(frozen=True)
class Rig:
    """A driver, not yet opened, and a real source that it can hear."""

    driver: Driver
    expected: Mapping[str, float]
    """The value of each of its signals, in the unit that was asked for."""
    say: Callable[[], None] = field(default=lambda: None)
    """Make the source say these once more; a source that speaks by itself, or is asked, needs none."""


def delivers_in_the_wanted_units_and_stamps_at_the_source(rig: Rig) -> None:
    """Samples bear the daemon's names and units, and a time on the monotonic clock that has just been."""
    begun = time.monotonic()
    samples = _collect(rig)
    now = time.monotonic()
    names = {sample.signal for sample in samples}
    _demand(names == set(rig.expected), f"samples of {sorted(names)}, expected {sorted(rig.expected)}")
    for sample in samples:
        value = rig.expected[sample.signal]
        close = math.isclose(sample.value, value, rel_tol=1e-4, abs_tol=1e-6)
        _demand(close, f"{sample.signal} is {sample.value}, expected {value}")
        _demand(begun - 0.1 <= sample.time <= now, f"{sample.signal} is stamped {sample.time - now:.3f} s from now")


def keeps_the_order_of_time(rig: Rig) -> None:
    """Of each signal no sample is older than the one before."""
    latest: dict[str, float] = {}
    for sample in _collect(rig):
        _demand(sample.time >= latest.get(sample.signal, -math.inf), f"{sample.signal} goes back in time")
        latest[sample.signal] = sample.time


def counts_what_it_receives(rig: Rig) -> None:
    """Every delivered sample is counted, and a healthy source has no bad ones."""
    samples = _collect(rig)
    counters = rig.driver.counters()
    _demand(counters.received >= len(samples), f"{counters.received} counted, {len(samples)} delivered")
    _demand(counters.bad == 0, f"{counters.bad} bad ones of a healthy source")


def never_delivers_nothing(rig: Rig) -> None:
    """Who takes samples is called when there are some."""
    got: list[Sample] = []
    empty: list[int] = []

    def deliver(samples: Sequence[Sample]) -> None:
        if not samples:
            empty.append(len(got))
        got.extend(samples)

    rig.driver.open(deliver)
    try:
        _wait(rig, got)
    finally:
        rig.driver.close()
    _demand(not empty, f"delivered nothing {len(empty)} times")


def says_that_it_is_connected(rig: Rig) -> None:
    """Down and with a reason before it is opened, up while samples come."""
    before = rig.driver.link()
    _demand(not before.up and bool(before.reason), "before it is opened the link is down, and says why")
    got: list[Sample] = []
    rig.driver.open(got.extend)
    try:
        _wait(rig, got)
        _demand(rig.driver.link().up, f"samples come, but the link is down: {rig.driver.link().reason}")
    finally:
        rig.driver.close()


def stops_within_a_second_and_leaves_nothing(rig: Rig) -> None:
    """After close, which may be called twice, no thread and no descriptor is left, and nothing more is delivered."""
    threads, descriptors = set(threading.enumerate()), _descriptors()
    got: list[Sample] = []
    rig.driver.open(got.extend)
    _wait(rig, got)
    begun = time.monotonic()
    rig.driver.close()
    rig.driver.close()
    _demand(time.monotonic() - begun < STOPS_WITHIN, f"closing took {time.monotonic() - begun:.2f} s")
    left = set(threading.enumerate()) - threads
    _demand(not left, f"threads left: {', '.join(thread.name for thread in left)}")
    while (left_open := _descriptors() - descriptors) > 0:  # the machine may be of this process, and closes its own end
        _demand(time.monotonic() - begun < STOPS_WITHIN, f"{left_open} descriptors left open")
        time.sleep(0.005)
    delivered = len(got)
    rig.say()
    time.sleep(0.05)  # what would come would have come
    _demand(len(got) == delivered, "samples were delivered after close")


def says_what_it_will_read(rig: Rig) -> None:
    """Every signal is in the description, before anything is opened."""
    text = "\n".join(rig.driver.describe())
    for name in rig.expected:
        _demand(name in text, f"{name} is not in the description")


def cannot_write(rig: Rig) -> None:
    """The protocol has five verbs and an adjective, and none of them speaks to the machine."""
    public = {name for name in dir(rig.driver) if not name.startswith("_")}
    _demand(public == VERBS, f"public names beside the protocol's: {sorted(public ^ VERBS)}")
    _demand(isinstance(rig.driver.sampling, Sampling), "sampling is one of otolith_drivers.base.Sampling")


CONTRACT: tuple[Callable[[Rig], None], ...] = (
    delivers_in_the_wanted_units_and_stamps_at_the_source,
    keeps_the_order_of_time,
    counts_what_it_receives,
    never_delivers_nothing,
    says_that_it_is_connected,
    stops_within_a_second_and_leaves_nothing,
    says_what_it_will_read,
    cannot_write,
)


def _collect(rig: Rig) -> list[Sample]:
    got: list[Sample] = []
    rig.driver.open(got.extend)
    try:
        _wait(rig, got)
    finally:
        rig.driver.close()
    return got


def _wait(rig: Rig, got: list[Sample]) -> None:
    deadline = time.monotonic() + PATIENCE
    while len(got) < ENOUGH or {sample.signal for sample in got} < set(rig.expected):
        _demand(time.monotonic() < deadline, f"{len(got)} samples in {PATIENCE:g} s: {rig.driver.link()}")
        rig.say()
        time.sleep(0.005)


def _descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - names are not needed


def _demand(condition: bool, promise: str) -> None:
    if not condition:
        raise AssertionError(promise)
