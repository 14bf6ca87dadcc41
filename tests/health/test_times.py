"""People read times in the zone of the plant, wherever the computer is; the texts of the core have UTC."""

from dataclasses import replace
from pathlib import Path

import pytest

from otolith.cli.operation.event_table import event_table
from otolith.health.text import event_text, headline, undecided_text
from otolith.health.times import clock_in, in_local_time, moment_text
from otolith.machine import load_machine
from otolith.publishing.recorder import operator_text
from otolith.runtime.replay import open_recorded
from otolith_drivers.common.time_zones import local_moment
from otolith_drivers.errors import ConfigurationError
from tests.conftest import OwnMachine
from tests.health.test_events import PLAN, assessed, of_length, report
from tests.health.test_hints import shown
from tests.messages import raises_saying

BERLIN, WINTER, SUMMER = "Europe/Berlin", 1768914200.0, 1784545400.0  # 2026-01-20 13:03:20 and 2026-07-20 11:03:20 UTC


def test_a_time_is_that_of_the_plant_with_its_zone() -> None:
    assert moment_text(WINTER, BERLIN) == "2026-01-20 14:03:20 CET"
    assert moment_text(SUMMER, BERLIN) == "2026-07-20 13:03:20 CEST"
    assert clock_in("Asia/Kolkata")(WINTER) == "2026-01-20 18:33:20 IST"
    assert moment_text(74.0, BERLIN) == "t = 74 s"  # a log without a time of day


def test_without_a_zone_it_is_that_of_the_computer() -> None:
    assert local_moment(WINTER).utcoffset() == local_moment(WINTER).astimezone().utcoffset()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("no i from 2026-01-20 13:03:20.25 UTC for 2 s", "no i from 2026-01-20 14:03:20.25 CET for 2 s"),
        ("2026-07-20 11:03:20 UTC to 2026-07-20 22:30:00 UTC", "2026-07-20 13:03:20 CEST to 2026-07-21 00:30:00 CEST"),
        ("from t = 5 s; 9999-99-99 99:99:99", "from t = 5 s; 9999-99-99 99:99:99"),
    ],
)  # fmt: skip
def test_dates_in_texts_of_the_core_are_converted(text: str, expected: str) -> None:
    assert in_local_time(text, BERLIN) == expected


@pytest.mark.parametrize("text", ["9999-99-99 99:99:99 UTC", "0000-01-01 00:00:00 UTC", "9999-12-31 23:59:59 UTC"])
def test_a_date_that_no_clock_shows_stays_as_it_is(text: str) -> None:
    """A device may write it."""
    assert in_local_time(text, BERLIN) == text


def test_every_screen_has_the_time_of_the_plant() -> None:
    """The log, the first tab of a recording, the live table and the table of events; the data have UTC."""
    plan = replace(PLAN, timezone=BERLIN)
    first = round(WINTER / 2.0)
    last = assessed([of_length(report(first + index, 5.8), 2.0) for index in range(5)], plan=plan)[-1]
    assert last.health is not None
    (event,) = last.events
    for text in (event_text(event), headline(last.health), operator_text(last), shown(last, details=False)):
        assert "2026-01-20 14:03:20 CET" in text
    assert "2026-01-20 14:03:30 CET" in shown(last, details=False)  # when it reported
    assert "14:03:20" in "".join(event_table([event], 120, plan.texts).columns[0].cells)  # type: ignore[arg-type]  # they are texts
    assert undecided_text(last) == ""
    assert (last.events[0].since, last.health.since) == (WINTER, WINTER)


def machine_with(own_machine: OwnMachine, zone: str) -> Path:
    text = own_machine.machine.read_text(encoding="utf-8")
    own_machine.machine.write_text(text.replace("[machine]", f'[machine]\ntimezone = "{zone}"'), encoding="utf-8")
    return own_machine.machine


@pytest.mark.parametrize(("zone", "hint"), [("Berlin", BERLIN), ("CEST+2", "/"), ("../../etc/passwd", "/")])
def test_a_zone_that_does_not_exist_is_refused(own_machine: OwnMachine, zone: str, hint: str) -> None:
    with raises_saying(ConfigurationError, "timezone", zone, "IANA", hint):
        load_machine(machine_with(own_machine, zone), with_driver=False)


@pytest.mark.parametrize(("zone", "begin"), [(BERLIN, WINTER), ("UTC", WINTER + 3600.0), (None, WINTER + 3600.0)])
def test_dates_of_a_log_without_a_zone_are_in_that_of_the_plant(
    own_machine: OwnMachine, tmp_path: Path, zone: str | None, begin: float
) -> None:
    rows = [f"2026-01-20 14:03:{20 + index // 10}.{index % 10},1,0.1,0.001,20" for index in range(30)]
    log = tmp_path / "log.csv"
    log.write_text("\n".join(["t,V_a,i,T_load,omega", *rows]) + "\n", encoding="utf-8")
    path = machine_with(own_machine, zone) if zone else own_machine.machine
    with open_recorded(load_machine(path, with_driver=False), log) as reader:
        assert next(iter(reader.chunks())).times[0] == pytest.approx(begin)
    own = log.read_text(encoding="utf-8").replace(",1,", "+05:30,1,")
    log.write_text(own, encoding="utf-8")
    with open_recorded(load_machine(path, with_driver=False), log) as reader:
        assert next(iter(reader.chunks())).times[0] == pytest.approx(WINTER - 4.5 * 3600.0)


@pytest.mark.parametrize("zone", ["Mars/Olympus", "../../etc/passwd", "a\nb", "\0", "x" * 5000])
def test_a_report_from_elsewhere_with_a_zone_that_is_unknown_here_has_times_of_this_computer(zone: str) -> None:
    assert local_moment(WINTER, zone) == local_moment(WINTER)
    assert local_moment(WINTER, zone).utcoffset() == local_moment(WINTER).utcoffset()
