"""CAN logs written by python-can from the frames of the simulated motor."""

import gzip
import shutil
from itertools import islice
from pathlib import Path
from typing import Any

import can
from cantools.database import Message

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.canbus.database import load_dbc
from otolith_drivers.canbus.decoder import decoder_of
from otolith_drivers.canbus.driver import Options, Source
from otolith_drivers.plant.can_node import ALIVE_COUNTER
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import simulate
from otolith_drivers.replay.can_log import CanLogReader, open_log
from otolith_drivers.replay.readers import Rows
from otolith_drivers.units import factor
from tests.conftest import EXAMPLES, SIGNALS

UNITS = {"V_a": "V", "T_load": "N*m", "i": "A", "omega": "rad/s"}
SETUP = Setup(tuple(Signal(name, unit, Source(signal=SIGNALS[name])) for name, unit in UNITS.items()), EXAMPLES, 0.01)
FRAMES = Options(dbc=Path("dc-motor.dbc"))
BEGUN = 1_700_000_000.0  # s, Unix
WRITERS: dict[str, Any] = {
    ".log": can.CanutilsLogWriter,
    ".asc": can.ASCWriter,
    ".blf": can.BLFWriter,
    ".trc": can.TRCWriter,
}


def frames_of(scenario: MotorScenario, count: int, begun: float = BEGUN) -> list[can.Message]:
    """Frames that the motor would send, each message with its own delay, and frames of another node."""
    messages = load_dbc(EXAMPLES / "dc-motor.dbc").messages
    units = scenario.SIGNALS
    frames = []
    for index, sample in enumerate(islice(simulate(scenario), count)):
        for place, message in enumerate(messages):
            time = begun + 0.01 * index + 0.0002 * (place + 1)
            frames.append(_frame(message, sample.measured, index, units, time))
        frames.append(
            can.Message(arbitration_id=0x7FF, data=b"other", timestamp=frames[-1].timestamp, is_extended_id=False)
        )
    return frames


def _frame(message: Message, measured: Any, index: int, units: dict[str, str], time: float) -> can.Message:
    values = {}
    for signal in message.signals:
        if signal.name.endswith(ALIVE_COUNTER):
            values[signal.name] = float(index % 2**signal.length)
        else:
            scale, offset = factor(units[signal.name], signal.unit or units[signal.name])
            values[signal.name] = scale * measured[signal.name] + offset
    data = message.encode(values, padding=True)
    return can.Message(
        timestamp=time,
        arbitration_id=message.frame_id,
        data=data,
        is_extended_id=message.is_extended_frame,
        channel=0,
    )


def live(frames: list[can.Message]) -> list[Sample]:
    """The samples that the CAN driver would deliver."""
    decoder = decoder_of(FRAMES, SETUP)
    return [sample for frame in frames for sample in decoder.decode(frame, frame.timestamp)]


def written(folder: Path, frames: list[can.Message], suffix: str) -> Path:
    """``frames`` in a file of the format of ``suffix``, compressed if it ends in ``.gz``."""
    plain = suffix.removesuffix(".gz")
    path = folder / f"bus{plain}"
    with WRITERS[plain](path) as writer:
        for frame in frames:
            writer(frame)
    if plain == suffix:
        return path
    packed = path.with_name(path.name + ".gz")
    with path.open("rb") as source, gzip.open(packed, "wb") as target:
        shutil.copyfileobj(source, target)
    return packed


def opened(path: Path) -> CanLogReader:
    return open_log(path, SETUP, FRAMES)


def samples_of(chunks: list[Rows]) -> list[tuple[str, float]]:
    """Signal and value of each reading, in the order of the rows."""
    samples = []
    for rows in chunks:
        for index in range(len(rows.times)):
            samples += [(name, float(c[index])) for name, c in rows.columns.items() if c[index] == c[index]]
    return samples
