"""A machine whose encoder has a CAN adapter of its own, which is not plugged in when the daemon starts."""

import os
import re
import struct
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from otolith.acquisition.window import Verdict
from otolith.health.limits import Level
from otolith.health.schema import EventDocument, ReportDocument, Status
from tests.conftest import EXAMPLES, OwnMachine
from tests.system.conftest import Running

SPEED = 10.0  # rad/s
# However busy the computer is, a window is good if the drive sends.
WINDOW = """
[window]
jitter_limit = "1 s"
surplus_limit = "90 %"
"""


class OwnAdapter(OwnMachine):
    """The example for two buses, with a serial CAN adapter instead of the Modbus encoder."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.adapter = folder / "adapter"
        text = (EXAMPLES / "dc-motor-two-buses.toml").read_text(encoding="utf-8")
        text = text.replace('dbc = "dc-motor.dbc"\n', f'dbc = "{self.dbc}"\n{self._bus()}')
        encoder = f'type = "can"\ninterface = "slcan"\nchannel = "{self.adapter}"\n'
        text = re.sub(r'type = "modbus"\n.*\n.*\n', encoder, text)
        place = 'id = "0x181", start = 0, length = 32, float = true, unit = "rad/s"'
        text = re.sub(r'register = 4, type = "float32", unit = "rad/s", delay = "25 ms"', place, text)
        self.machine.write_text(f'{text}{WINDOW}\n[zenoh]\nlisten = ["{self.endpoint}"]\n', encoding="utf-8")


@contextmanager
def plugged_in(link: Path) -> Iterator[None]:
    """A serial CAN adapter at ``link``, on whose bus a frame with the speed comes every 10 ms."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    frame = f"t1814{struct.pack('<f', SPEED).hex()}\r".encode()
    done = threading.Event()

    def send() -> None:
        while not done.wait(0.01):
            os.write(ours, frame)

    thread = threading.Thread(target=send)
    thread.start()
    link.symlink_to(os.ttyname(theirs))
    try:
        yield
    finally:
        done.set()
        thread.join()
        os.close(ours)
        os.close(theirs)


def encoder_event(report: ReportDocument) -> EventDocument | None:
    """The event of the absent encoder, if the report has it."""
    return next((event for event in report.events if "source 'encoder'" in event.text), None)


def test_an_adapter_that_is_missing_at_the_start_is_an_event_until_it_is_plugged_in(tmp_path: Path) -> None:
    machine = OwnAdapter(tmp_path / "machine")
    running = Running(machine, tmp_path)
    try:
        last = running.wait_for(lambda reports: any(map(is_good_but_warned, reports)))[-1]
        event = encoder_event(last)
        assert event is not None
        assert event.part == "bus"
        assert "source 'encoder' (omega) is down" in event.text
        assert str(machine.adapter) in event.text
        assert last.driver is not None
        assert last.driver.sources["drive"].up
        assert last.health is not None
        assert last.health.parts["bus"].state is Level.WATCH
        assert last.parameters["R_a"].status is not Status.INVALID
        with plugged_in(machine.adapter):
            seen = len(running.reports)
            reports = running.wait_for(lambda all_of: any(is_cleared(report) for report in all_of[seen:]))
        assert reports[-1].driver is not None
        assert reports[-1].driver.sources["encoder"].received > 0
    finally:
        running.close()


def is_good_but_warned(report: ReportDocument) -> bool:
    """Whether the window is good, and the encoder is an event all the same."""
    event = encoder_event(report)
    return report.window.quality.verdict is Verdict.GOOD and event is not None and event.state is Level.WATCH


def is_cleared(report: ReportDocument) -> bool:
    """Whether the event of the absent encoder ends with this report."""
    event = encoder_event(report)
    return event is not None and event.end is not None
