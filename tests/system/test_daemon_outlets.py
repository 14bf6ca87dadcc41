"""Outlets of a daemon without a site: machines come and go, and what happens to their process harms none of them."""

import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.sites.outlets.rigs import MqttRig, PrometheusRig
from tests.system.halls import RunningHall, write
from tests.waiting import PATIENCE, wait_for

DONE = "machines are served"


def with_outlets(folder: Path, name: str, *rigs: MqttRig | PrometheusRig) -> None:
    write(folder, name)
    tables = "".join(f"\n[outlets.{rig.name}]\n{rig.table()}\n" for rig in rigs)
    file = folder / f"{name}.toml"
    file.write_text(file.read_text(encoding="utf-8") + tables, encoding="utf-8")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "machines").mkdir()
    return tmp_path / "machines"


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[MqttRig]:
    rig = MqttRig(tmp_path)
    rig.start()
    yield rig
    rig.stop()


def outlet_process(hall: RunningHall, port: int) -> psutil.Process:
    """The child that listens for scrapes."""
    (own,) = [each for each in hall.children()
              if any(link.laddr and link.laddr.port == port for link in each.net_connections("tcp"))]  # fmt: skip
    return own


def test_machines_of_a_hall_are_passed_on_and_no_outlet_delays_them(
    folder: Path, broker: MqttRig, tmp_path: Path
) -> None:
    scrape = PrometheusRig(tmp_path)
    with_outlets(folder, "one", scrape, broker)
    with_outlets(folder, "two", scrape)
    write(folder, "three")
    hall = RunningHall(folder)
    try:
        hall.have(1, "one", "two", "three")
        wait_for(lambda: scrape.states().keys() == {"one", "two"} and broker.states().keys() == {"one"}, PATIENCE)
        outlet_process(hall, scrape.port).send_signal(signal.SIGSTOP)  # it hangs
        hall.have(2, "one", "two", "three")
        outlet_process(hall, scrape.port).kill()
        wait_for(lambda: scrape.states().keys() == {"one", "two"}, PATIENCE)  # another one was started
        with_outlets(folder, "two")
        with_outlets(folder, "three", scrape, broker)
        (folder / "one.toml").unlink()
        hall.reload(DONE)
        wait_for(lambda: scrape.states().keys() == {"three"} and broker.states().keys() == {"three"}, PATIENCE)
        counters = hall.reports["two"][-1].counters
        assert counters is not None
        assert counters.worker_restarts == 0
    finally:
        assert hall.close() == 0
    retained = broker.retained()
    assert retained["otolith/demo/three/availability"] == b"offline"
