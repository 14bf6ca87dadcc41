"""A service that was enabled goes on after a boot. The first test ends one, each other one runs in its own."""

import json
from pathlib import Path

from tests.vm.conftest import run
from tests.vm.service import Before, Instance

WHOLE = Path.home() / "whole.rrd"


def remembered(press: Instance) -> Before:
    return Before(**json.loads(press.remembered.read_text(encoding="utf-8")))


def test_before_a_reboot(press: Instance) -> None:
    """The tests of the next boot go on from here."""
    press.remember(press.before())
    assert not press.failure()


def test_after_a_reboot() -> None:
    press = Instance("press")
    press.check_continued(remembered(press))
    press.remember(press.before())


def test_after_a_power_cut() -> None:
    press = Instance("press")
    press.check_continued(remembered(press))
    assert not list(press.state.rglob("*.kept.*"))
    recordings = sorted(press.state.rglob("*.rrd"))
    assert len(recordings) >= 2
    for recording in recordings:  # what is whole of each can be opened
        run("/opt/otolith/bin/rerun", "rrd", "optimize", "--continue-on-error", str(recording), "-o", str(WHOLE))
        assert WHOLE.stat().st_size > 0
