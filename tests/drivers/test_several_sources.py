"""Several drivers as one: the contract of every driver, and what one source that is down changes."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.estimation.information import Identifiability
from otolith.health.schema import ParameterDocument, Status
from otolith.health.status import absent_sources, driver_document, with_absent_sources
from otolith_drivers import conformance
from otolith_drivers.base import Counters, Deliver, Driver, Link, Sample, Sampling
from otolith_drivers.common.guard import GuardedSource
from otolith_drivers.conformance import CONTRACT, Rig
from otolith_drivers.errors import DeviceError
from otolith_drivers.sources import SeveralSources
from tests.conftest import OwnMachine
from tests.drivers.rigs import RIGS
from tests.messages import assert_each_says, raises_saying
from tests.waiting import PATIENCE, wait_for, within


class FakeDriver:
    """Delivers one sample when it is opened."""

    def __init__(self, link: Link, counters: Counters, sampling: Sampling, fault: str = "") -> None:
        self.sampling, self._link, self._counters, self.fault = sampling, link, counters, fault
        self.calls: list[str] = []

    def open(self, deliver: Deliver) -> None:
        self.calls.append("open")
        if self.fault:
            raise DeviceError(self.fault)
        deliver([Sample("x", time.monotonic(), 2.0)])

    def close(self) -> None:
        self.calls.append("close")

    def counters(self) -> Counters:
        return self._counters

    def link(self) -> Link:
        return self._link

    def describe(self) -> list[str]:
        return ["a bus", "x from it"]


def both(first: Link, second: Link, fault: str = "") -> tuple[SeveralSources, tuple[FakeDriver, FakeDriver]]:
    one = FakeDriver(first, Counters(10, 1, 2, 3), Sampling.CYCLIC)
    two = FakeDriver(second, Counters(20, 0, 0, 1), Sampling.POLLED, fault)
    sources = (GuardedSource("drive", one, ("V_a", "i")), GuardedSource("encoder", two, ("omega",)))
    return SeveralSources(sources), (one, two)


UP = Link(up=True, warnings=("frame 0x1 is silent",), plan="every 10 ms", period=0.01)
DOWN = Link(up=False, reason="connection refused")


def test_one_source_down_is_a_warning_and_both_down_is_a_lost_connection() -> None:
    link = both(UP, DOWN)[0].link()
    assert link.up
    assert_each_says(link.warnings, ("'encoder'", "connection refused"), ("drive", "frame 0x1 is silent"))
    assert (link.plan, link.period) == ("drive: every 10 ms", None)
    link = both(DOWN, DOWN)[0].link()
    assert not link.up
    assert_each_says(link.reason.split("; "), ("'drive'", "connection refused"), ("'encoder'", "connection refused"))


@pytest.mark.timed
def test_sources_that_hang_while_they_open_or_close_do_not_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    sources, (one, two) = both(UP, DOWN, fault="no such interface")
    opening, held = threading.Event(), threading.Event()

    def hang_in_open(_: Deliver) -> None:
        opening.set()
        held.wait(PATIENCE)

    def hang_in_close() -> None:
        held.wait(PATIENCE)

    sources.open(lambda _: None)
    monkeypatch.setattr(two, "open", hang_in_open)
    monkeypatch.setattr(one, "close", hang_in_close)
    assert opening.wait(PATIENCE)
    begun = time.monotonic()
    sources.close()
    took = time.monotonic() - begun
    held.set()
    wait_for(lambda: two.calls[-2:] == ["close", "close"])  # at once, and again when it is open
    assert took < within(1.0)


def test_counters_are_summed_and_kept_for_each_source() -> None:
    sources, _ = both(UP, DOWN)
    assert sources.counters() == Counters(30, 1, 2, 4)
    document = driver_document(sources.link())
    assert {name: source.reconnects for name, source in document.sources.items()} == {"drive": 3, "encoder": 1}
    assert document.sources["encoder"].signals == ("omega",)


def test_the_period_is_the_shortest_if_all_sources_are_polled() -> None:
    assert both(UP, replace(UP, period=0.05))[0].link().period == 0.01
    assert both(UP, replace(UP, period=None))[0].link().period is None


def test_each_signal_has_the_sampling_of_its_source() -> None:
    sampling = both(UP, UP)[0].sampling
    assert sampling == {"V_a": Sampling.CYCLIC, "i": Sampling.CYCLIC, "omega": Sampling.POLLED}


def test_a_source_that_cannot_be_opened_is_named_and_tried_again_while_the_others_deliver(
    caplog: pytest.LogCaptureFixture,
) -> None:
    sources, (one, two) = both(UP, UP, fault="can9: no such interface")
    received: list[Sample] = []
    sources.open(received.extend)
    try:
        assert len(received) == 1
        assert sources.link().up
        assert "source 'encoder' is down: can9: no such interface" in sources.link().warnings
        wait_for(lambda: two.calls.count("open") >= 3)
        two.fault = ""
        wait_for(lambda: len(received) == 2)
        wait_for(lambda: not any("is down" in warning for warning in sources.link().warnings))
    finally:
        sources.close()
    assert one.calls == ["open", "close"]
    assert two.calls[-1] == "close"
    assert caplog.text.count("can9: no such interface") == 1


def test_sources_of_which_none_can_be_opened_are_an_error() -> None:
    one, two = (FakeDriver(UP, Counters(), Sampling.TRUE, fault) for fault in ("can8: no such", "can9: no such"))
    sources = SeveralSources((GuardedSource("drive", one, ("i",)), GuardedSource("encoder", two, ("omega",))))
    with raises_saying(DeviceError, "'drive': can8: no such", "'encoder': can9: no such"):
        sources.open(lambda _: None)
    assert one.calls == two.calls == ["open", "close"]


def parameter(status: Status) -> ParameterDocument:
    return ParameterDocument(
        value=None, unit="ohm", nominal=1.0, status=status, progress=0.0,
        identifiability=Identifiability.WEAK, reason="the current does not change",
    )  # fmt: skip


def window(*missing: str) -> Window:
    """A window in which some signals have no sample."""
    whole = Window.whole(0, 0.0, 0.01, ("V_a", "i", "omega"), np.ones((3, 3)))
    return replace(whole, missing=np.tile([name in missing for name in whole.signals], (3, 1)))


@pytest.mark.parametrize(
    ("link", "missing", "cause"),
    [
        (DOWN, (), "is down: connection refused"),
        (UP, ("omega",), "is silent: frame 0x1 is silent"),
        (Link(up=True), ("omega",), "sent nothing in this window"),
        (Link(up=True), ("V_a",), ""),
        (UP, ("i",), ""),
    ],
)
def test_a_source_is_absent_if_it_is_down_or_gave_no_sample(link: Link, missing: tuple[str, ...], cause: str) -> None:
    absent = absent_sources(both(UP, link)[0].link(), window(*missing), {"i", "omega"})
    assert absent == ({"encoder": f"source 'encoder' (omega) {cause}"} if cause else {})


def test_a_source_of_commands_may_be_silent() -> None:
    assert not absent_sources(both(Link(up=True), UP)[0].link(), window("V_a", "i"), {"omega"})


def test_a_parameter_that_is_not_estimated_names_the_absent_source() -> None:
    parameters = {"R_a": parameter(Status.ESTIMATED), "J": parameter(Status.HELD)}
    named = with_absent_sources(parameters, {"encoder": "source 'encoder' (omega) is down: connection refused"})
    assert named["R_a"] == parameters["R_a"]
    cause = "source 'encoder' (omega) is down: connection refused"
    assert named["J"].reason == f"{cause}; the current does not change"
    assert with_absent_sources(parameters, None) == parameters


@contextmanager
def two_buses(machine: OwnMachine) -> Iterator[Rig]:
    """The current over CAN and the speed over Modbus TCP."""
    with ExitStack() as stack:
        rigs = {name: stack.enter_context(RIGS[name](machine)) for name in ("can", "modbus")}
        only = {"can": "i", "modbus": "omega"}
        sources = tuple(
            GuardedSource(name, cast("Driver", OneSignal(rigs[name], signal)), (signal,))
            for name, signal in only.items()
        )
        yield Rig(SeveralSources(sources), rigs["can"].expected, rigs["can"].emit)


class OneSignal:
    """The driver of a rig, of whose signals only one is delivered."""

    def __init__(self, rig: Rig, signal: str) -> None:
        self._driver, self._signal = rig.driver, signal
        for name in ("sampling", "close", "counters", "link", "describe"):
            setattr(self, name, getattr(self._driver, name))

    def open(self, deliver: Deliver) -> None:
        def some(samples: Sequence[Sample]) -> None:
            if kept := [sample for sample in samples if sample.signal == self._signal]:
                deliver(kept)

        self._driver.open(some)


@pytest.mark.timed
@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_two_buses_keep_the_contract(
    check: Callable[[Rig], None], own_machine: OwnMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conformance, "SAMPLES_TIMEOUT", PATIENCE)
    monkeypatch.setattr(conformance, "CLOSE_TIMEOUT", within(conformance.CLOSE_TIMEOUT))
    with two_buses(own_machine) as rig:
        check(rig)
        rig.driver.close()
