"""Whatever a driver of another package does, the daemon and its other sources go on, and its source names it."""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from otolith.acquisition.ring import Rings
from otolith.acquisition.window import Window
from otolith.health.status import absent_sources, driver_document
from otolith_drivers.base import Counters, Deliver, Driver, Link, Sample, Sampling
from otolith_drivers.common import guard
from otolith_drivers.common.guard import GuardedSource
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.sources import SeveralSources
from tests.waiting import PATIENCE, wait_for

UP = Link(up=True)


class PlugIn:
    """A driver that works, until a test gives it other methods."""

    sampling: Any = Sampling.TRUE

    def __init__(self, **parts: Any) -> None:
        for name, part in parts.items():
            setattr(self, name, part)

    def open(self, deliver: Deliver) -> None:
        deliver([Sample("x", time.monotonic(), 1.0)])

    def close(self) -> None:
        pass

    def counters(self) -> Counters:
        return Counters(received=1)

    def link(self) -> Link:
        return UP

    def describe(self) -> list[str]:
        return ["a plug-in"]


class NoTextError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text either")


def raises(error: BaseException) -> Callable[..., Any]:
    def method(*_: Any) -> Any:
        raise error

    return method


def returns(value: Any) -> Callable[..., Any]:
    return lambda *_: value


class Unprintable:
    def __repr__(self) -> str:
        raise ValueError("no repr")


class NoAttributes:
    """What build() may return by mistake."""


HUGE = "x" * 50_000_000
WRONG_METHODS: dict[str, tuple[Any, str]] = {
    "link raises": (PlugIn(link=raises(ZeroDivisionError("division by zero"))), "link() raises ZeroDivisionError"),
    "link exits": (PlugIn(link=raises(SystemExit(3))), "link() raises SystemExit"),
    "link raises what has no text": (PlugIn(link=raises(NoTextError())), "link() raises NoTextError"),
    "link returns nothing": (PlugIn(link=returns(None)), "link() returns None"),
    "link returns what has no repr": (PlugIn(link=returns(Unprintable())), "value of type Unprintable"),
    "up is a text": (PlugIn(link=returns(Link(up=cast("bool", "yes")))), "link() returns"),
    "period is NaN": (PlugIn(link=returns(Link(up=True, period=math.nan))), "period of nan"),
    "period is tiny": (PlugIn(link=returns(Link(up=True, period=1e-300))), "period of 1e-300"),
    "period is a text": (PlugIn(link=returns(Link(up=True, period=cast("float", "1")))), "period of '1'"),
    "latency is infinite": (PlugIn(link=returns(Link(up=True, latency=math.inf))), "latency of inf"),
    "latency is negative": (PlugIn(link=returns(Link(up=True, latency=-1.0))), "latency of -1"),
    "warnings are a text": (PlugIn(link=returns(Link(up=True, warnings=cast("tuple[str]", "abc")))), "lines of text"),
    "a warning is a number": (PlugIn(link=returns(Link(up=True, warnings=cast("tuple[str]", (1,))))), "returns 1"),
    "counters raises": (PlugIn(counters=raises(KeyError("n"))), "counters() raises KeyError"),
    "counters returns a table": (PlugIn(counters=returns({"received": 1})), "counters() returns"),
    "counters are NaN": (PlugIn(counters=returns(Counters(bad=cast("int", math.nan)))), "counters() returns"),
    "counters are negative": (PlugIn(counters=returns(Counters(lost=-1))), "counters() returns"),
    "counters are huge": (PlugIn(counters=returns(Counters(lost=1 << 80))), "counters() returns"),
    "describe raises": (PlugIn(describe=raises(OSError("no"))), "describe() raises OSError"),
    "describe returns a text": (PlugIn(describe=returns("a bus")), "lines of text"),
    "describe returns nothing": (PlugIn(describe=returns([])), "lines of text"),
    "sampling is unknown": (PlugIn(sampling="now and then"), "sampling"),
    "sampling lacks a signal": (PlugIn(sampling={"y": Sampling.TRUE}), "sampling"),
    "open raises": (PlugIn(open=raises(ValueError("bad handshake"))), "open() raises ValueError: bad handshake"),
    "all is missing": (NoAttributes(), "AttributeError"),
}  # fmt: skip


@contextmanager
def machine_with(driver: Any, signal: str = "x") -> Iterator[tuple[SeveralSources, Rings]]:
    """A machine with this driver, and a healthy one of the signal ``y``; opened, and closed at the end."""
    rings = Rings(("x", "y"), 100)
    healthy = PlugIn(open=lambda deliver: deliver([Sample("y", time.monotonic(), 2.0)]))
    sources = SeveralSources(
        (GuardedSource("plug-in", driver, (signal,), 0.01), GuardedSource("healthy", cast("Driver", healthy), ("y",)))
    )
    try:
        sources.open(rings.deliver)
        yield sources, rings
    finally:
        sources.close()


def use_all(driver: GuardedSource | SeveralSources) -> Link:
    """Call what the daemon calls in a window, and check that a report can carry the answers."""
    counters, link = driver.counters(), driver.link()
    assert all(isinstance(getattr(counters, name), int) for name in Counters.__dataclass_fields__)
    assert len(driver_document(link).model_dump_json()) < 20_000
    assert set(driver.sampling) == {"x", "y"} if isinstance(driver.sampling, Mapping) else driver.sampling in Sampling
    assert all(isinstance(line, str) for line in driver.describe())
    return driver.link()


def events(link: Link) -> dict[str, str]:
    """The sources that become events of a good window."""
    whole = Window.whole(0, 0.0, 0.01, ("x", "y"), np.ones((3, 2)))
    return absent_sources(link, whole, {"x", "y"})


@pytest.mark.parametrize("case", WRONG_METHODS)
def test_a_plug_in_that_misbehaves_is_an_event_of_its_source_and_the_others_go_on(case: str) -> None:
    driver, expected = WRONG_METHODS[case]
    with machine_with(driver) as (machine, rings):
        found = events(use_all(machine))
        assert set(found) == {"plug-in"}
        assert expected in found["plug-in"]
        assert machine.link().up
        assert math.isfinite(rings.last_times()["y"])


@pytest.mark.parametrize("case", WRONG_METHODS)
def test_so_it_is_if_it_is_the_only_source(case: str) -> None:
    driver, expected = WRONG_METHODS[case]
    source = GuardedSource("plug-in", driver, ("x",), 0.01)
    source.open(lambda _: None)
    assert expected in events(use_all(source))["plug-in"]
    source.close()


def test_a_driver_of_the_package_says_in_the_thread_that_asks_how_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[threading.Thread]()

    class Own(PlugIn):
        def counters(self) -> Counters:
            asked.append(threading.current_thread())
            return Counters()

        def link(self) -> Link:
            asked.append(threading.current_thread())
            raise ValueError("no state")

    monkeypatch.setattr(Own, "__module__", "otolith_drivers.own")
    source = GuardedSource("own", cast("Driver", Own()), ("x",), 0.01)
    source.counters()
    assert "link() raises ValueError: no state" in source.link().defect
    assert set(asked) == {threading.current_thread()}


def test_a_healthy_plug_in_is_no_event() -> None:
    with machine_with(PlugIn()) as (machine, _):
        link = use_all(machine)
        assert not events(link)
        assert (link.up, link.warnings, machine.counters()) == (True, (), Counters(received=2))


def test_a_defect_that_is_over_is_none_any_more(caplog: pytest.LogCaptureFixture) -> None:
    driver = PlugIn(link=raises(ValueError("for a moment")))
    with machine_with(driver) as (machine, _):
        for _repeat in range(3):
            assert events(machine.link())
        setattr(driver, "link", returns(UP))  # noqa: B010 - a method for the type checker
        assert not events(machine.link())
    assert caplog.text.count("for a moment") == 1


def test_a_huge_text_is_cut() -> None:
    link = Link(up=False, reason=HUGE, warnings=(HUGE,) * 1000, plan=HUGE)
    with machine_with(PlugIn(link=returns(link), describe=returns([HUGE] * 1000))) as (machine, _):
        assert len(driver_document(machine.link()).model_dump_json()) < 500_000
        assert sum(map(len, machine.describe())) < 200_000
        assert "950 lines more" in machine.link().warnings[-1]


@pytest.mark.parametrize("method", ["link", "counters", "describe"])
def test_a_call_that_blocks_is_waited_for_once_and_then_a_defect(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    held, calls = threading.Event(), list[int]()

    def block() -> Any:
        calls.append(1)
        held.wait(PATIENCE)
        return getattr(PlugIn(), method)()

    with machine_with(PlugIn(**{method: block})) as (machine, _):
        for _repeat in range(20):
            use_all(machine)
        assert not events(machine.link())
        monkeypatch.setattr(guard, "STUCK", 0.0)
        use_all(machine)
        assert f"{method}() has not returned for" in events(machine.link())["plug-in"]
        assert len(calls) == 1
        held.set()
        wait_for(lambda: not events(use_all(machine)))


def test_a_thread_that_ends_its_call_late_does_not_end_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """The outcome of a call can be taken before its thread says that it has returned."""
    held, told = threading.Event(), threading.Event()

    class Late(threading.Event):
        def set(self) -> None:
            if not told.is_set():
                told.set()
                held.wait(PATIENCE)
            super().set()

    with monkeypatch.context() as patch:
        patch.setattr(threading, "Event", Late)
        call = guard._Call("link()")
        with pytest.raises(TimeoutError):
            call.run(lambda: told.wait(0.1) or 1, 0.01)
        wait_for(told.is_set)
    assert call.run(lambda: 0, PATIENCE) == 1

    def last() -> int:
        held.set()
        time.sleep(0.1)
        return 2

    assert call.run(last, PATIENCE) == 2


def test_open_that_blocks_keeps_nobody_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "OPEN_TIMEOUT", 0.01)
    held = threading.Event()
    closed = list[float]()

    def block(deliver: Deliver) -> None:
        held.wait(PATIENCE)
        deliver([Sample("x", time.monotonic(), 1.0)])

    with machine_with(PlugIn(open=block, close=lambda: closed.append(1))) as (machine, rings):
        assert math.isfinite(rings.last_times()["y"])
        assert "open() has not returned" in events(machine.link())["plug-in"]
        held.set()
        wait_for(lambda: not events(machine.link()))
        assert math.isfinite(rings.last_times()["x"])
    assert closed


@pytest.mark.parametrize("close", [raises(OSError("gone")), lambda: time.sleep(PATIENCE)], ids=["raises", "blocks"])
def test_close_ends_in_time_and_raises_nothing(close: Callable[[], None]) -> None:
    with machine_with(PlugIn(close=close)) as (machine, _):
        begin = time.monotonic()
        machine.close()
        assert time.monotonic() - begin < 0.5 * PATIENCE


NOW = "now"
WRONG_SAMPLES: dict[str, Any] = {
    "no sequence": 7,
    "a generator that raises": (1 / 0 for _ in range(3)),
    "no sample": [None],
    "too few parts": [("x", 1.0)],
    "the name is a number": [(1, NOW, 1.0)],
    "the name is unhashable": [([], NOW, 1.0)],
    "the time is NaN": [Sample("x", math.nan, 1.0)],
    "the time is a text": [("x", "12:00", 1.0)],
    "the time is of another clock": [Sample("x", 1.7e12, 1.0)],
    "the time is long ago": [Sample("x", -1e9, 1.0)],
    "the value is a text": [("x", NOW, "1.0")],
    "the value is none": [("x", NOW, None)],
    "the value is complex": [("x", NOW, 1j)],
    "the value is an array": [("x", NOW, np.ones(3))],
    "what has no repr": [Unprintable()],
}


@pytest.mark.parametrize("case", WRONG_SAMPLES)
def test_samples_that_are_none_are_refused_and_counted_and_the_rest_is_used(case: str) -> None:
    def deliver_wrong(deliver: Deliver) -> None:
        now, wrong = time.monotonic(), WRONG_SAMPLES[case]
        if isinstance(wrong, list):
            parts = [item if not isinstance(item, tuple) else tuple(now if part is NOW else part for part in item)
                     for item in wrong]  # fmt: skip
            wrong = [Sample("x", now, 3.0), *parts, Sample("x", now, cast("float", np.float32(4.0)))]
        deliver(wrong)
        deliver([Sample("x", now, math.nan)])

    with machine_with(PlugIn(open=deliver_wrong)) as (machine, rings):
        assert machine.counters().bad == 1
        assert "it delivers" in events(machine.link())["plug-in"]
        read = rings.around("x", -math.inf, math.inf, 0.0)[1]
        np.testing.assert_equal(read, [3.0, 4.0, math.nan] if isinstance(WRONG_SAMPLES[case], list) else [math.nan])


def test_a_thread_of_a_driver_that_ends_by_an_exception_is_named(caplog: pytest.LogCaptureFixture) -> None:
    deliveries: list[Deliver] = []

    class Threaded(PlugIn):
        def open(self, deliver: Deliver) -> None:
            deliveries.append(deliver)
            threading.Thread(target=self._run, daemon=True).start()

        def _run(self) -> None:
            raise IndexError("no more bytes")

    with machine_with(Threaded()) as (machine, _), caplog.at_level(logging.ERROR):
        wait_for(lambda: "IndexError: no more bytes" in events(machine.link()).get("plug-in", ""))
        wait_for(lambda: "restart the daemon" in caplog.text)  # it is logged after it is stated
        assert caplog.text.count("restart the daemon") == 1
        deliveries[0]([Sample("x", time.monotonic(), 1.0)])
        assert not events(machine.link())


def test_a_driver_that_cannot_be_built_is_down_and_the_others_go_on() -> None:
    source = GuardedSource.built("plug-in", ("x",), 0.01, raises(RuntimeError("no licence")))
    machine = SeveralSources((source, GuardedSource("healthy", cast("Driver", PlugIn()), ("y",))))
    machine.open(lambda _: None)
    assert "build() raises RuntimeError: no licence" in events(use_all(machine))["plug-in"]
    machine.close()
    with pytest.raises(ConfigurationError):
        GuardedSource.built("plug-in", ("x",), 0.01, raises(ConfigurationError("no such column")))


def test_a_computer_that_lacks_something_ends_the_only_source_with_an_error() -> None:
    source = GuardedSource("plug-in", cast("Driver", PlugIn(open=raises(DeviceError("no can0")))), ("x",))
    with pytest.raises(DeviceError, match="no can0"):
        source.open(lambda _: None)
    assert source.link().reason == "no can0"
    assert replace(source.link(), reason="") == Link(up=False)


def test_nothing_is_delivered_after_close() -> None:
    deliveries: list[Deliver] = []
    received: list[Sequence[Sample]] = []
    source = GuardedSource("plug-in", cast("Driver", PlugIn(open=deliveries.append)), ("x",))
    source.open(received.append)
    source.close()
    deliveries[0]([Sample("x", time.monotonic(), 1.0)])
    assert not received
