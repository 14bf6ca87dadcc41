"""Pictures of the docs, for ``make screens``: reports and recordings of a motor, healthy and with three faults.

Reports are shown by a headless Chromium, recordings by the Rerun viewer without a window. On Debian: ``apt install
chromium mesa-vulkan-drivers``.
"""

import os
import signal
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest import mock

from PIL import Image
from rerun.experimental import ViewerClient

from benchmarks.browser import Browser
from benchmarks.diagnosis import machine_of, of_scenario
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health.schema import CountersDocument, Report
from otolith.machine import LoadedMachine
from otolith.publishing.html_report import html_report
from otolith.publishing.recorder import Recording
from otolith.storage.history import SUFFIX, WINDOW, describe_machine
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.base import Sampling

START = 1_790_000_000.0  # Unix s of the first window
COUNT = 60  # windows
SEED = 5
SIZE = (1280, 720)  # pixels
PAUSE, TRIES = 5.0, 12  # s between pictures of the viewer, longer than it shows a notice
BAR = 38  # pixels: of the window of the viewer
COLOURS = 200  # of a PNG file
MACHINE, SITE = "press-3", "hall-1"
FAULTS: dict[str, dict[str, Any]] = {
    "healthy": {},
    "degrading": {"kind": "drift", "start": "20 s", "parameter": "R_a", "amount": "-0.013 ohm", "rate": "0.03 1/s"},
    "unbalance": {"kind": "unbalance", "start": "60 s", "acceleration": "4.5 rad/s^2", "order": 1.0},
    "sensor-fault": {"kind": "frozen", "start": "80 s", "signal": "ArmatureCurrent"},
}


@cache
def motor() -> LoadedMachine:
    """Return the machine of all pictures."""
    return machine_of("motor")


def simulated(situation: str, count: int = COUNT) -> list[Report]:
    """Return the reports of the first ``count`` windows of a situation."""
    return reports_of(FAULTS[situation], count, SEED)


def reports_of(fault: dict[str, Any], count: int, seed: int) -> list[Report]:
    """Return the reports of the first ``count`` windows of the motor with a fault."""
    machine = motor()
    state = initial_state(MACHINE, SITE, machine.problem, machine.plan)
    reports = []
    for index, window in enumerate(of_scenario("demo", fault, machine, seed, count=count), 1):
        state, report = adapt(state, replace(window, start=START + window.start))
        counters = CountersDocument(received=index * window.records * len(machine.twin.signals), windows=index)
        reports.append(replace(report, document=report.document.model_copy(update={"counters": counters})))
    return reports


def page(reports: Sequence[Report], folder: Path) -> str:
    """Return the page of a machine, whose history is in ``folder`` afterwards."""
    writer = HistoryWriter(folder / f"{SITE}.{MACHINE}{SUFFIX}", Bounds(200_000_000, 3650.0, 24.0))
    numbers, _ = writer.open(START)
    writer.description = describe_machine(motor().twin, motor().plan)
    with mock.patch("time.time", return_value=reports[-1].document.window.end):  # the age of windows at the end
        for report in reports:
            writer.add(numbers.number(report.document))
            writer.write()
        writer.stop(0.0)
        writer.write()
    samples = writer.reader.samples(WINDOW, START)
    return html_report(writer.reader, samples, "window", START, reports[-1].document.window.end)


def recording_picture(reports: Sequence[Report], folder: Path) -> bytes:
    """Return what the viewer shows of a recording, as PNG; ``folder`` has the recording afterwards."""
    path, image = folder / "recording.rrd", folder / "recording.png"
    recording = Recording(path, replace(motor().recorded(Sampling.CYCLIC), title=f"{MACHINE} at {SITE}"))
    for report in reports:
        recording.add(report)
    recording.close()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program, size = f"{sysconfig.get_path('scripts')}/rerun", f"{SIZE[0]}x{SIZE[1] + BAR}"
    place = ["--headless", "--renderer", "vulkan", "--bind", "127.0.0.1", "--port", f"{port}", "--window-size", size]
    environment = {**os.environ, "XDG_CONFIG_HOME": str(folder)}
    subprocess.run([program, "analytics", "disable"], env=environment, capture_output=True, check=True)  # noqa: S603 - our viewer
    with subprocess.Popen([program, *place, str(path)], env=environment, stdout=subprocess.DEVNULL,  # noqa: S603 - our viewer
                          stderr=subprocess.DEVNULL, start_new_session=True) as viewer:  # fmt: skip
        try:
            return _without_bar(_settled(port, image))
        finally:
            os.killpg(viewer.pid, signal.SIGKILL)


def _settled(port: int, image: Path) -> bytes:
    """Return the first picture of a viewer that is like the one before: all is loaded, and its notices are gone."""
    before = b""
    for _ in range(TRIES):
        time.sleep(PAUSE)
        ViewerClient(f"rerun+http://127.0.0.1:{port}/proxy").save_screenshot(str(image))
        if (shown := image.read_bytes()) == before:
            return shown
        before = shown
    sys.exit(f"{image.name}: the viewer shows something else in each of {TRIES} pictures")


def _without_bar(picture: bytes) -> bytes:
    """Return a picture without the bar of the window, which has notices about the computer that made it."""
    output, whole = BytesIO(), Image.open(BytesIO(picture))
    whole.crop((0, BAR, *whole.size)).save(output, "PNG")
    return output.getvalue()


def reduced(picture: bytes, size: tuple[int, int] = SIZE) -> bytes:
    """Return a PNG file in its size on a screen and with few colours."""
    output = BytesIO()
    whole = Image.open(BytesIO(picture)).convert("RGB")
    image = whole if whole.size == size else whole.resize(size, Image.Resampling.LANCZOS)
    method = Image.Quantize.MAXCOVERAGE  # the median cut makes the thin lines of two limits one colour
    image.quantize(COLOURS, method, dither=Image.Dither.NONE).save(output, "PNG", optimize=True)
    return output.getvalue()


def write_situations(folder: Path, tab: Browser) -> None:
    """Write report and recording of each situation into ``folder``."""
    with tempfile.TemporaryDirectory() as name:
        for situation in FAULTS:
            place = Path(name) / situation
            place.mkdir()
            reports = simulated(situation)
            file = place / "report.html"
            file.write_text(page(reports, place), encoding="utf-8")
            tab.open(file, *SIZE)
            (folder / f"report-{situation}.png").write_bytes(reduced(tab.picture()))
            (folder / f"recording-{situation}.png").write_bytes(reduced(recording_picture(reports, place)))
