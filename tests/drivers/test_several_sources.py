"""Several drivers as one: the contract of every driver, and what one source that is down changes."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from otolith.estimation.information import Identifiability
from otolith.health.schema import ParameterDocument, Status, Traces
from otolith.publishing.connection import driver_document, with_missing_sources
from otolith_drivers import conformance
from otolith_drivers.base import Counters, Deliver, Driver, Link, Sample, Sampling
from otolith_drivers.conformance import CONTRACT, Rig
from otolith_drivers.errors import DeviceError
from otolith_drivers.several_sources import NamedSource, SeveralSources
from tests.conftest import OwnMachine
from tests.drivers.rigs import RIGS
from tests.waiting import PATIENCE, within


class FakeDriver:
    """Delivers one sample when it is opened."""

    def __init__(self, link: Link, counters: Counters, sampling: Sampling, fault: str = "") -> None:
        self.sampling, self._link, self._counters, self._fault = sampling, link, counters, fault
        self.calls: list[str] = []

    def open(self, deliver: Deliver) -> None:
        self.calls.append("open")
        if self._fault:
            raise DeviceError(self._fault)
        deliver([Sample("x", 1.0, 2.0)])

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
    sources = (NamedSource("drive", one, ("V_a", "i")), NamedSource("encoder", two, ("omega",)))
    return SeveralSources(sources), (one, two)


UP = Link(up=True, warnings=("frame 0x1 is silent",), plan="every 10 ms", period=0.01)
DOWN = Link(up=False, reason="connection refused")


def test_one_source_down_is_a_warning_and_both_down_is_a_lost_connection() -> None:
    link = both(UP, DOWN)[0].link()
    assert link.up
    assert link.warnings == ("source 'encoder' is down: connection refused", "drive: frame 0x1 is silent")
    assert (link.plan, link.period) == ("drive: every 10 ms", None)
    link = both(DOWN, DOWN)[0].link()
    assert not link.up
    assert link.reason == "source 'drive' is down: connection refused; source 'encoder' is down: connection refused"


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


def test_a_source_that_cannot_be_opened_closes_the_others_and_is_named() -> None:
    sources, (one, _) = both(UP, DOWN, fault="can9: no such interface")
    with pytest.raises(DeviceError, match="source 'encoder': can9: no such interface"):
        sources.open(lambda _: None)
    assert one.calls == ["open", "close"]


def parameter(status: Status) -> ParameterDocument:
    return ParameterDocument(
        value=None, unit="ohm", nominal=1.0, status=status, progress=0.0,
        identifiability=Identifiability.WEAK, reason="the current does not change",
    )  # fmt: skip


def window(**missing: bool) -> Traces:
    """The curves of a window in which some signals have no sample."""
    values = {name: np.where(missing.get(name, False), np.nan, np.ones(3)) for name in ("i", "omega", "V_a")}
    measured = np.column_stack([values["i"], values["omega"]])
    return Traces(np.arange(3.0), ("i", "omega"), measured, None, (1.0, 1.0), ("V_a",), values["V_a"][:, None])


@pytest.mark.parametrize(
    ("link", "cause"),
    [
        (DOWN, "is down: connection refused"),
        (UP, "is silent: frame 0x1 is silent"),
        (Link(up=True), "sent nothing in this window"),
    ],
)
def test_a_parameter_that_is_not_estimated_names_the_source_that_gave_no_sample(link: Link, cause: str) -> None:
    parameters = {"R_a": parameter(Status.ESTIMATED), "J": parameter(Status.HELD)}
    driver = driver_document(both(UP, link)[0].link())
    named = with_missing_sources(parameters, driver, window(omega=True))
    assert named["R_a"] == parameters["R_a"]
    assert named["J"].reason == f"omega missing, because source 'encoder' {cause}; the current does not change"
    assert with_missing_sources(parameters, driver, window()) == parameters
    assert with_missing_sources(parameters, driver, window(i=True)) == parameters


@contextmanager
def two_buses(machine: OwnMachine) -> Iterator[Rig]:
    """The current over CAN and the speed over Modbus TCP."""
    with ExitStack() as stack:
        rigs = {name: stack.enter_context(RIGS[name](machine)) for name in ("can", "modbus")}
        only = {"can": "i", "modbus": "omega"}
        sources = tuple(
            NamedSource(name, cast("Driver", OneSignal(rigs[name], signal)), (signal,)) for name, signal in only.items()
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
