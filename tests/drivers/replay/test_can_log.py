"""CAN logs: the samples and windows of the live bus; damage is counted and located."""

import gzip
import re
import threading
from bisect import bisect_right
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith.acquisition.playback import Playback
from otolith.acquisition.quality import QualityLimits
from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Window
from otolith.acquisition.windower import Windower
from otolith_drivers.base import Sampling
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay.readers import Rows
from tests.acquisition.series import cut_next
from tests.drivers.logs import BEGUN, UNITS, frames_of, live, opened, samples_of, written
from tests.messages import assert_refuses, raises_saying
from tests.waiting import PATIENCE

SUFFIXES = [".log", ".asc", ".blf", ".trc"]
PACKED = [*SUFFIXES, *(f"{suffix}.gz" for suffix in SUFFIXES)]
TICKS, RECORDS, PERIOD = 1000, 200, 0.01
PLANS = tuple(SignalPlan(name, sampling=Sampling.CYCLIC) for name in UNITS)
LIMITS = QualityLimits(missing=0.05, gap=0.05)
FRAME = re.compile(r"\s0?181[\s#]")  # the heads of some formats have times in them, in which there may be any digits


@pytest.fixture
def frames(scenario: MotorScenario) -> list[can.Message]:
    return frames_of(scenario, TICKS)


def read(path: Path) -> tuple[list[Rows], str, list[str]]:
    """All rows, the summary and the warnings."""
    with opened(path) as log:
        rows = list(log.chunks())
        return rows, ", ".join(log.summary_lines()), log.warnings()


def windows_of(chunks: list[Rows]) -> list[Window]:
    playback = Playback(PLANS, RECORDS, PERIOD, LIMITS)
    return [window for rows in chunks for window in playback.windows(rows)] + list(playback.rest())


@pytest.mark.parametrize("suffix", PACKED)
def test_can_log_samples_equal_live_samples(tmp_path: Path, frames: list[can.Message], suffix: str) -> None:
    rows, summary, warnings = read(written(tmp_path, frames, suffix))
    from_bus = live(frames)
    assert samples_of(rows) == [(sample.signal, sample.value) for sample in from_bus]
    times = np.concatenate([part.times for part in rows])
    expected = np.array([frame.timestamp for frame in frames if frame.arbitration_id != 0x7FF])
    assert np.diff(times) == pytest.approx(np.diff(expected), abs=2e-6)  # the formats count microseconds
    if not suffix.startswith(".asc"):  # whose times begin with the log
        assert times == pytest.approx(expected, abs=2e-6)
    assert f"{len(frames)} frames read, {TICKS} of other messages, 0 bad" in summary
    assert warnings == []


def cut_live(frames: list[can.Message]) -> list[Window]:
    """The windows that the service would cut while the frames come."""
    rings = Rings(tuple(UNITS), 4 * RECORDS)
    windower = Windower(PLANS, RECORDS, PERIOD, LIMITS)
    samples, windows = live(frames), list[Window]()
    now, last = BEGUN, samples[-1].time
    while now < last + 0.5:
        arrived = bisect_right(samples, now, key=lambda sample: sample.time)
        rings.deliver(samples[:arrived])
        del samples[:arrived]
        if windower.begin(rings, now, now - BEGUN):
            while windower.due(rings, now):
                windows.append(cut_next(windower, rings))
        now += 0.004
    return windows


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_can_log_windows_equal_live_windows(tmp_path: Path, frames: list[can.Message], suffix: str) -> None:
    replayed = windows_of(read(written(tmp_path, frames, suffix))[0])
    from_bus = cut_live(frames)
    assert len(replayed) == len(from_bus) == TICKS // RECORDS
    for one, other in zip(replayed, from_bus, strict=True):
        assert np.array_equal(one.values, other.values)
        assert not one.missing.any()
        assert one.quality.verdict == "good"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_can_log_locates_frames_out_of_order(tmp_path: Path, frames: list[can.Message], suffix: str) -> None:
    """Text writers correct times that go back, so lines are moved; a BLF is written in this order."""
    path = written(tmp_path, frames, suffix)
    if suffix == ".blf":
        late = frames[:3]
        with can.BLFWriter(path) as writer:
            for frame in [*frames[30:2000], *late, *frames[2000:]]:
                writer(frame)
        place = 1971
    else:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        first = next(index for index, line in enumerate(lines) if FRAME.search(line))
        lines[first + 2000 : first + 2000] = lines[first : first + 3]
        path.write_text("".join(lines[:first] + lines[first + 30 :]), encoding="utf-8")
        place = first + 1971
    playback = Playback(PLANS, RECORDS, PERIOD, LIMITS)
    with opened(path) as log:
        for rows in log.chunks():
            list(playback.windows(rows))
    assert playback.counts.reordered == playback.counts.late == 2
    assert playback.counts.first_late is not None
    assert playback.counts.first_late[0] == place
    assert playback.counts.lost == 4


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_can_log_warns_of_a_missing_message(tmp_path: Path, frames: list[can.Message], suffix: str) -> None:
    electrical = [frame for frame in frames if frame.arbitration_id != 0x281]
    _, _, warnings = read(written(tmp_path, electrical, suffix))
    assert any("0x281) has not come once" in line for line in warnings)


@pytest.mark.parametrize(
    ("suffix", "damaged"),
    [
        (".log", "(1700000001.5) vcan0 181#01\n"),
        (".log", "(1700000001.5) vcan0 1"),
        (".log", "1700000001.5 vcan0 181#0102\n"),
        (".log", "(now) vcan0 181#0000000000000000\n"),
        (".log", "(nan) vcan0 181#0000000000000000\n"),
        (".asc", " 1.500000 1  181             Rx   d 8 0G 00 00 00 00 00 00 00\n"),
        (".asc", " 1.500000 1  181             Rx   d 8 00\n"),
        (".trc", "    100       500.000 DT  1     0181 Rx -  8    00 0\n"),
        (".trc", "    100       500.000 DT  1\n"),
        (".trc", "    100       five DT  1     0181 Rx -  8    00 00 00 00 00 00 00 00\n"),
    ],
)
def test_can_log_counts_and_locates_a_damaged_line(
    tmp_path: Path, frames: list[can.Message], suffix: str, damaged: str
) -> None:
    path = written(tmp_path, frames[:300], suffix)
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    first = next(index for index, line in enumerate(lines) if FRAME.search(line))
    lines.insert(first + 150, damaged if damaged.endswith("\n") else damaged + "\n")
    path.write_text("".join(lines), encoding="utf-8")
    rows, summary, warnings = read(path)
    assert samples_of(rows) == [(sample.signal, sample.value) for sample in live(frames[:300])]
    assert "1 bad" in summary
    assert len(warnings) == 1
    assert f"bad: 1, the first in line {first + 151}: " in warnings[0]


@pytest.mark.parametrize("suffix", [".log", ".asc", ".trc"])
def test_can_log_rejects_a_last_line_without_end(tmp_path: Path, frames: list[can.Message], suffix: str) -> None:
    path = written(tmp_path, frames[:300], suffix)
    text = path.read_text(encoding="utf-8").rstrip()
    path.write_text(text.removesuffix("End TriggerBlock").rstrip()[:-7], encoding="utf-8")
    _, summary, warnings = read(path)
    assert "300 frames read" in summary or "299 frames read" in summary
    assert "1 bad" in summary
    assert "line" in warnings[0]


def test_can_log_warns_of_a_truncated_file(tmp_path: Path, frames: list[can.Message]) -> None:
    whole = written(tmp_path, frames, ".blf").read_bytes()
    path = tmp_path / "cut.blf"
    path.write_bytes(whole[: len(whole) // 2])
    rows, _, warnings = read(path)
    assert 100 < len(samples_of(rows)) < 4 * TICKS
    assert any("cut off" in line for line in warnings)
    packed = written(tmp_path, frames, ".log.gz")
    packed.write_bytes(packed.read_bytes()[:-1000])
    rows, _, warnings = read(packed)
    assert 100 < len(samples_of(rows)) < 4 * TICKS
    assert any("cut off" in line for line in warnings)


def test_can_log_refuses_a_blf_without_header(tmp_path: Path) -> None:
    path = tmp_path / "killed.blf"
    for content in (b"", b"LOGG", b"\0" * 4096, b"no BLF at all, but long enough for the head of one" * 10):
        path.write_bytes(content)
        with raises_saying(ConfigurationError, "killed.blf", "not a BLF", "writer was killed"):
            opened(path)
    writer = can.BLFWriter(path)
    writer.file.flush()
    with pytest.raises(ConfigurationError, match="no frames"):
        read(path)
    writer.stop()


def test_can_log_without_wanted_frames_names_them(tmp_path: Path) -> None:
    other = can.Message(arbitration_id=0x123, data=bytes(8), is_extended_id=False, timestamp=1.0)
    with raises_saying(ConfigurationError, "5 frames", "0x181, 0x281"):
        read(written(tmp_path, [other] * 5, ".log"))


def test_can_log_warns_of_frames_from_two_channels(tmp_path: Path, frames: list[can.Message]) -> None:
    for frame in frames[1::2]:
        frame.channel = 1
    _, _, warnings = read(written(tmp_path, frames, ".blf"))
    assert any("channels 0, 1" in line for line in warnings)


def check_any(path: Path, held: int = 0) -> None:
    """Refused with a reason, or read; what is not used is counted, and what is lost of ``held`` frames has a cause."""
    try:
        rows, summary, warnings = read(path)
    except ConfigurationError as error:
        assert_refuses(error, path)
        return
    assert all(np.isfinite(part.times).all() for part in rows)
    used = sum(len(part.times) for part in rows)
    found, others, bad = (int(number) for number in re.findall(r"(\d+) (?:frames? read|of other|bad)", summary))
    assert used + others <= found <= used + others + bad
    assert not bad or any(str(bad) in line for line in warnings)
    assert found >= held or "without a frame" in summary or bad or warnings


@settings(max_examples=60)
@given(st.sampled_from(PACKED), st.binary(max_size=300))
def test_can_log_of_random_bytes_is_refused_or_counted(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(gzip.compress(content) if suffix.endswith(".gz") else content)
    check_any(path)
    path.write_bytes(content)
    check_any(path)


SHARE = st.floats(0.0, 1.0, exclude_max=True)


@settings(max_examples=150)
@given(st.sampled_from(PACKED), st.lists(st.tuples(SHARE, st.integers(0, 255)), max_size=4), SHARE)
def test_can_log_with_changed_bytes_is_refused_or_read(
    tmp_path: Path, frames: list[can.Message], suffix: str, changes: list[tuple[float, int]], end: float
) -> None:
    content = bytearray(written(tmp_path, frames[:30], suffix).read_bytes())
    for place, value in changes:
        content[int(place * len(content))] = value
    path = tmp_path / f"damaged{suffix}"
    path.write_bytes(content[: int(end * len(content)) + 1])
    check_any(path, held=30)


@pytest.mark.parametrize("size", [0, 1, 15])
def test_can_log_with_a_zero_size_blf_object_ends(tmp_path: Path, frames: list[can.Message], size: int) -> None:
    path = tmp_path / "loop.blf"
    with can.BLFWriter(path, compression_level=0) as writer:
        for frame in frames[:100]:
            writer(frame)
    content = bytearray(path.read_bytes())
    at = content.find(b"LOBJ", content.find(b"LOBJ") + 4 + 1000)
    content[at + 8 : at + 12] = size.to_bytes(4, "little")
    path.write_bytes(content)
    done = threading.Event()

    def check() -> None:
        check_any(path)
        done.set()

    threading.Thread(target=check, daemon=True).start()
    assert done.wait(PATIENCE)
