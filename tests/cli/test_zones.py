"""Commands read and tell times in the zone of the machine, wherever the computer is."""

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import click
import pytest

from otolith.cli.common import local_time
from otolith.cli.operation.history import Since, age_or_date
from otolith.machine import load_machine
from otolith_drivers.common.time_zones import comes_twice
from otolith_drivers.errors import ConfigurationError
from tests.cli.commands import otolith
from tests.cli.replays import MACHINE
from tests.messages import assert_says, raises_saying

TOKYO = "Asia/Tokyo"
NOON = datetime(2026, 1, 31, 12, tzinfo=UTC).timestamp()


@pytest.fixture(autouse=True)
def _of_new_york(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The computer is elsewhere than the machine."""
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    text = MACHINE.read_text(encoding="utf-8").replace("[machine]", f'[machine]\ntimezone = "{TOKYO}"')
    path.write_text(text, encoding="utf-8")
    return path


def test_a_time_is_told_in_the_zone_of_the_machine_or_of_the_computer() -> None:
    assert local_time(NOON, TOKYO) == "2026-01-31 21:00:00 JST"
    assert local_time(NOON, None) == "2026-01-31 07:00:00 EST"


@pytest.mark.parametrize(
    ("text", "zone"),
    [("2026-01-31T21:00", TOKYO), ("2026-01-31T07:00", None), ("2026-01-31T12:00+00:00", TOKYO)],
    ids=["of the machine", "of the computer", "with a zone"],
)
def test_a_date_is_read_in_the_zone_in_which_times_are_told(text: str, zone: str | None) -> None:
    context = click.Context(click.Command("history"))
    assert age_or_date(context, click.Option(["--since"]), text).before(0.0, zone) == NOON


BERLIN = "Europe/Berlin"


@pytest.mark.parametrize("zone", [BERLIN, None])
def test_a_date_that_comes_twice_is_asked_about(zone: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Summer time ends at 03:00, which is 02:00 again."""
    monkeypatch.setenv("TZ", BERLIN if zone is None else "Asia/Tokyo")
    time.tzset()

    def read(text: str) -> Since:
        return age_or_date(click.Context(click.Command("history")), click.Option(["--since"]), text)

    with raises_saying(ConfigurationError, "02:30", "twice", "02:30:00+02:00 (CEST)", "02:30:00+01:00 (CET)"):
        read("2026-10-25T02:30").before(0.0, zone)
    first, second = (read(f"2026-10-25T02:30+0{hours}:00").before(0.0, zone) for hours in (2, 1))
    assert second - first == 3600.0
    assert read("2026-10-25T03:00").before(0.0, zone) == second + 1800.0
    told = [comes_twice(at, zone) for at in (first - 1801.0, first, second, second + 1800.0)]
    assert told == [False, True, True, False]


def test_commission_speaks_of_the_zone_of_the_machine(file: Path) -> None:
    with pytest.raises(click.UsageError) as caught:
        otolith("commission", file, "--since", "2026-01-31T21:00", "--until", "2026-01-31T20:00")
    assert_says(caught.value.message, "21:00:00 JST", "20:00:00 JST")


def test_a_list_of_recordings_has_the_zone_of_the_machine(file: Path) -> None:
    machine = load_machine(file, with_driver=False)
    names, folder = machine.file.machine, machine.recording_folder
    folder.mkdir(parents=True)
    recording = folder / f"{names.site}.{names.name}-20260131T110000-1.rrd"
    recording.write_bytes(b"RRF2")
    assert_says(otolith("view", file, "--list").stdout, "JST", recording.name)
