"""Lost, repeated, corrupted and missing frames are counted exactly and reported in words."""

import math
import struct
from collections.abc import Iterable
from functools import reduce
from operator import xor
from pathlib import Path
from random import Random
from typing import Any

import crccheck.crc
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith_drivers.canbus.decoder import FrameDecoder
from otolith_drivers.canbus.monitoring import COUNTER_NAMES, OTHER_COUNTER_NAMES
from otolith_drivers.common.message_times import PeriodEstimator
from otolith_drivers.errors import ConfigurationError
from tests.drivers.can_frames import dbc, decoder, frame
from tests.messages import assert_each_says

PERIOD = 0.01
MOTOR = dbc(
    """BO_ 385 Motor: 8 Drive
 SG_ Voltage : 0|16@1- (0.01,0) [0|0] "V" Monitor
 SG_ Current : 16|16@1- (0.01,0) [0|0] "A" Monitor
 SG_ Crc : 48|8@1+ (1,0) [0|0] "" Monitor
 SG_ AliveCounter : 56|8@1+ (1,0) [0|255] "" Monitor
 SG_ Tick : 40|4@1+ (1,0) [0|0] "" Monitor"""
)
WISHES = {"V_a": ("V", {"signal": "Voltage"}), "i": ("A", {"signal": "Current"})}
UNCOUNTED = {"messages": {"Motor": {"counter": False}}}
COUNTED = {"messages": {"Motor": {"counter": "AliveCounter"}}}


def motor(folder: Path, **options: Any) -> FrameDecoder:
    frame_decoder = decoder(folder, WISHES, MOTOR, **options)
    frame_decoder.begin(0.0)
    return frame_decoder


def send(frame_decoder: FrameDecoder, index: int, time: float | None = None, *, count: int | None = None) -> int:
    """The frame ``index`` of a drive that sends every 10 ms; how many samples it gave."""
    counter = index if count is None else count
    data = bytes(5) + bytes([counter % 15]) + bytes([0, counter % 256])
    return len(frame_decoder.decode(frame(385, data), index * PERIOD if time is None else time))


def send_all(frame_decoder: FrameDecoder, *indices: range) -> None:
    for part in indices:
        for index in part:
            send(frame_decoder, index)


@pytest.mark.parametrize("options", [UNCOUNTED, COUNTED, {}], ids=["period", "declared counter", "recognised counter"])
@pytest.mark.parametrize("lost", [1, 2, 7, 254, 255, 256, 257, 300, 1000])
def test_lost_frames_are_counted_exactly(tmp_path: Path, options: dict[str, Any], lost: int) -> None:
    """With a counter, also over several of its cycles, and without one."""
    frame_decoder = motor(tmp_path, **options)
    send_all(frame_decoder, range(100), range(100 + lost, 200 + lost))
    assert frame_decoder.counters.lost == 2 * lost
    assert frame_decoder.counters.received == 400
    assert frame_decoder.counters.bad == 0


@pytest.mark.parametrize("options", [COUNTED, {}], ids=["declared", "recognised"])
@pytest.mark.parametrize("jitter", [0.0, 0.2, 5.0], ids=["regular", "with jitter", "irregular"])
def test_a_counter_that_jumps_at_random_is_named_and_counts_no_losses(
    tmp_path: Path, options: dict[str, Any], jitter: float
) -> None:
    """After it has counted for a while; and when it counts again, it is used again."""
    frame_decoder, random, time = motor(tmp_path, **options), Random(1), 0.0  # noqa: S311 - no secret

    def send_counts(counts: Iterable[int]) -> None:
        nonlocal time
        for count in counts:
            late = random.uniform(-jitter, jitter) if jitter < 1.0 else random.expovariate(1.0 / jitter)
            time += PERIOD * (1.0 + late)
            send(frame_decoder, 0, time, count=count)

    send_counts(range(400))
    assert not any("random" in line for line in frame_decoder.warnings(time))
    send_counts(random.randrange(256) for _ in range(5000))
    named = [line for line in frame_decoder.warnings(time) if "random" in line]
    assert_each_says(named, ("AliveCounter", "Motor", "counter = false"))
    assert frame_decoder.counters.lost < (100 if jitter < 1.0 else 1000)  # some irregular intervals look regular
    send_counts(range(100))
    assert not any("random" in line for line in frame_decoder.warnings(time))


@pytest.mark.parametrize("lost", [1, 5, 40, 200])
def test_losses_of_an_irregular_message_are_counted_by_its_counter(tmp_path: Path, lost: int) -> None:
    frame_decoder, random, time = motor(tmp_path, **COUNTED), Random(1), 0.0  # noqa: S311 - no secret
    for index in [*range(400), *range(400 + lost, 500 + lost)]:
        time += random.expovariate(20.0)
        send(frame_decoder, index, time)
    assert frame_decoder.counters.lost == 2 * lost


@settings(deadline=None)
@given(
    gaps=st.lists(st.integers(1, 60), min_size=1, max_size=8),
    jitter=st.floats(0, 0.2),
    seed=st.integers(0, 1000),
)
def test_lost_count_is_exact_with_jitter_and_many_gaps(gaps: list[int], jitter: float, seed: int) -> None:
    random = Random(seed)  # noqa: S311 - jitter, not a secret
    periods, lost, place = PeriodEstimator(), 0, 0.0
    for index in range(60 + 20 * len(gaps)):
        place += 1 + (gaps[(index - 60) // 20] if index >= 60 and index % 20 == 0 else 0)
        lost += periods.lost_before((place + jitter * random.random()) * PERIOD)
    assert lost == sum(gaps)


@settings(deadline=None)
@given(
    frames=st.lists(st.tuples(st.floats(0, 3), st.integers(0, 255), st.integers(0, 8)), max_size=200),
    options=st.sampled_from([UNCOUNTED, COUNTED, {}]),
)
def test_every_frame_is_either_delivered_or_bad(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[float, int, int]], options: dict[str, Any]
) -> None:
    frame_decoder, time, delivered = motor(tmp_path_factory.mktemp("any"), **options), 0.0, 0
    for pause, count, length in frames:
        time += pause
        before = frame_decoder.counters
        samples = frame_decoder.decode(frame(385, (bytes(7) + bytes([count]))[:length]), time)
        after = frame_decoder.counters
        delivered += len(samples)
        missing = sum(math.isnan(sample.value) for sample in samples)
        assert after.bad - before.bad == (missing if samples else 1)
        assert after.lost >= before.lost
        assert all("\n" not in line for line in frame_decoder.warnings(time))
    assert frame_decoder.counters.received == delivered


def test_counter_with_a_modulo_of_fifteen(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path, messages={"Motor": {"counter": "Tick", "modulo": 15}})
    send_all(frame_decoder, range(100), range(140, 200))
    assert frame_decoder.counters.lost == 2 * 40
    assert frame_decoder.counters.bad == 0


def test_held_up_frames_are_not_lost(tmp_path: Path) -> None:
    """An adapter that stamps frames on arrival shows a gap and then a burst."""
    for options in (UNCOUNTED, COUNTED, {"messages": {"Motor": {"counter": "Tick", "modulo": 15}}}):
        frame_decoder = motor(tmp_path, **options)
        send_all(frame_decoder, range(100))
        for index in range(100, 140):
            send(frame_decoder, index, time=1.40 + 1e-4 * (index - 100))
        send_all(frame_decoder, range(141, 200))
        assert frame_decoder.counters.lost == 2  # frame 140
        assert frame_decoder.counters.bad == 0


def test_irregular_messages_lose_nothing_without_a_counter(tmp_path: Path) -> None:
    frame_decoder, time = motor(tmp_path, **UNCOUNTED), 0.0
    for index in range(400):
        time += (0.001, 0.3, 0.02, 1.1)[index * index % 4 + index % 3 % 2]
        send(frame_decoder, index, time)
    assert frame_decoder.counters.lost == 0


def test_a_long_outage_is_no_loss(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path, **UNCOUNTED)
    send_all(frame_decoder, range(100), range(1_000_000, 1_000_100))
    assert frame_decoder.counters.lost == 0


def test_a_changed_period_is_estimated_anew(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path, **UNCOUNTED)
    send_all(frame_decoder, range(100))
    for index in range(600):
        send(frame_decoder, index, time=1.0 + 0.002 * index)
    before = frame_decoder.counters.lost
    for index in range(100):
        send(frame_decoder, index, time=2.3 + 0.002 * index)
    assert (before, frame_decoder.counters.lost - before) == (0, 2 * 50)


def received(intervals: list[float]) -> tuple[PeriodEstimator, int]:
    """An estimator after frames with these intervals (s), and the number of frames that it counts as lost."""
    periods, time, lost = PeriodEstimator(), 0.0, 0
    for interval in (0.0, *intervals):
        time += interval
        lost += periods.lost_before(time)
    return periods, lost


def test_a_drifting_period_is_tracked() -> None:
    periods, lost = received([0.01 * (1.0 + 0.0005 * index) for index in range(2000)])
    assert periods.period == pytest.approx(0.02, rel=0.05)
    assert lost == 0


def test_a_burst_at_the_start_gives_no_wrong_period() -> None:
    periods, lost = received([1e-4] * 20 + [0.01] * 200)
    assert periods.period == pytest.approx(0.01, rel=0.05)
    assert (periods.regular, lost) == (True, 0)


@pytest.mark.parametrize(
    ("pattern", "regular"), [([0.01] * 9 + [0.02], True), ([0.01, 0.01, 0.02], False)], ids=["1 of 10", "1 of 3"]
)
def test_a_message_is_regular_if_most_intervals_are(pattern: list[float], regular: bool) -> None:
    assert received(pattern * 20)[0].regular is regular


def test_gaps_at_the_start_do_not_change_the_estimate() -> None:
    periods, _ = received([0.6, 0.6, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3] + [0.3] * 8)
    assert periods.period == pytest.approx(0.3)
    assert periods.regular


@pytest.mark.parametrize("seed", range(5))
def test_a_message_at_random_times_counts_hardly_any_losses(seed: int) -> None:
    """By chance, intervals may look regular for a while: then long ones would count as losses."""
    random = Random(seed)  # noqa: S311 - no secret
    _, lost = received([random.expovariate(20.0) for _ in range(5000)])
    assert lost < 100


def test_several_gaps_in_a_row_keep_the_period() -> None:
    assert received([0.01] * 100 + [0.02] * 10 + [0.01] * 20)[1] == 10


def test_a_stuck_counter_delivers_nothing_and_is_a_warning(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path, **COUNTED)
    send_all(frame_decoder, range(60))
    given = [send(frame_decoder, index, count=59) for index in range(60, 70)]
    assert given == [0] * 10
    assert (frame_decoder.counters.received, frame_decoder.counters.bad, frame_decoder.counters.lost) == (120, 10, 0)
    assert_each_says(frame_decoder.warnings(0.7), ("AliveCounter", "Motor (0x181)", "10 frames"))
    send_all(frame_decoder, range(70, 71))
    assert frame_decoder.warnings(0.71) == []
    assert frame_decoder.counters.lost == 2 * 10  # the repeated frames replaced new ones


def test_a_counter_recognised_by_name_must_count_first(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path)
    for index in range(100):
        assert send(frame_decoder, index, count=7) == 2
    assert frame_decoder.counters.bad == 0
    assert frame_decoder.warnings(1.0) == []


def test_warning_of_a_recognised_counter_names_the_option(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path)
    send_all(frame_decoder, range(50))
    for index in range(50, 55):
        assert send(frame_decoder, index, count=49) == 0
    assert "set driver.messages.Motor.counter = false" in frame_decoder.warnings(0.55)[0]


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("ElectricalAliveCounter", True),
        ("AliveCounter", True),
        ("RollingCounter", True),
        ("Msg_Counter", True),
        ("SequenceCounter", True),
        ("ESP_21_BZ", True),
        ("COUNTER", True),
        ("Axis3_CNT", True),
        ("CF_Clu_AliveCnt", True),
        ("SeqCnt", True),
        ("ErrorCounter", False),
        ("EncoderCnt", False),
        ("Pulse_Counter", False),
        ("StartCounter", False),
        ("Current", False),
        ("Counterweight", False),
        ("OperatingHours_CNT", False),
    ],
)
def test_counter_names(name: str, counts: bool) -> None:
    assert (bool(COUNTER_NAMES.search(name)) and not OTHER_COUNTER_NAMES.search(name)) is counts


CHECKSUMS = {
    "crc8-sae-j1850": crccheck.crc.Crc8SaeJ1850.calc,
    "crc8-autosar": crccheck.crc.Crc8Autosar.calc,
    "xor": lambda data: reduce(xor, data),
    "sum8": lambda data: sum(data) % 256,
}


@pytest.mark.parametrize("kind", CHECKSUMS)
def test_frames_with_a_wrong_checksum_are_bad(tmp_path: Path, kind: str) -> None:
    table = {"signal": "Crc", "kind": kind, "over": [0, 7], "suffix": "A5 01"}
    frame_decoder = motor(tmp_path, messages={"Motor": {"checksum": table, "counter": "AliveCounter"}})
    for index in range(20):
        data = bytearray(struct.pack("<hhBBBB", index, 2 * index, 3, 0, 0, index))
        data[6] = CHECKSUMS[kind](bytes(data[:6] + data[7:]) + b"\xa5\x01")
        if index in (5, 6):
            data[index % 3] ^= 0x10
        samples = frame_decoder.decode(frame(385, bytes(data)), index * PERIOD)
        assert len(samples) == (0 if index in (5, 6) else 2)
    assert (frame_decoder.counters.received, frame_decoder.counters.bad, frame_decoder.counters.lost) == (36, 2, 0)
    assert_each_says(frame_decoder.warnings(0.2), ("Motor (0x181)", "checksum", "2 ", "0.1 s"))


def test_checksums_have_the_published_check_values() -> None:
    """The check values of the catalogue of parametrised CRC algorithms, and of AUTOSAR's SWS CRC Library."""
    from otolith_drivers.canbus.monitoring import checksum_algorithm  # noqa: PLC0415 - only this test looks inside

    known = {
        "crc8-sae-j1850": 0x4B,
        "crc8-sae-j1850-zero": 0x37,
        "crc8-autosar": 0xDF,
        "crc16-ccitt-false": 0x29B1,
        "xor": 0x31,
        "sum8": 0xDD,
    }
    for kind, expected in known.items():
        assert checksum_algorithm(kind)[0](b"123456789") == expected, kind  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"counter": "Alive"}, "Motor has no signal 'Alive'"),
        (
            {"checksum": {"signal": "Tick", "kind": "xor"}},
            "xor takes 8 bits, unsigned and in whole bytes; Tick is different",
        ),
        ({"checksum": {"signal": "Crc", "kind": "crc16-ccitt-false"}}, "crc16-ccitt-false takes 16 bits"),
        ({"checksum": {"signal": "Crc", "kind": "xor", "over": [0, 8]}}, "bytes 0 to 8 are not within the 8 bytes"),
    ],
)
def test_invalid_message_tables_are_refused(tmp_path: Path, table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        motor(tmp_path, messages={"Motor": table})
    assert sentence in str(caught.value)
    assert caught.value.key[:3] == ("driver", "messages", "Motor")


def test_counter_given_by_its_bits(tmp_path: Path) -> None:
    source = {"id": "0x181", "start": 0, "length": 16, "unit": "V"}
    table = {"0x181": {"counter": {"start": 56, "length": 8}, "period": "10 ms"}}
    frame_decoder = decoder(tmp_path, {"V_a": ("V", source)}, messages=table)
    send_all(frame_decoder, range(20), range(23, 40))
    assert frame_decoder.counters.lost == 3
    assert "frames 0x181 are counted by counter, every 10.0 ms" in frame_decoder.describe()


def test_silence_warning_gives_the_period(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path)
    send_all(frame_decoder, range(100))
    assert frame_decoder.warnings(1.4) == []
    assert_each_says(frame_decoder.warnings(0.99 + 3.2), ("Motor (0x181)", "silent", "3.2 s", "10.0 ms"))
    send_all(frame_decoder, range(419, 421))
    assert frame_decoder.warnings(4.21) == []


def test_silence_warning_before_the_period_is_known(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path)
    send_all(frame_decoder, range(3))
    assert frame_decoder.warnings(5.0) == []
    assert_each_says(frame_decoder.warnings(12.02), ("Motor (0x181)", "silent", "12.0 s", "period"))


def test_a_message_that_never_comes_is_a_warning(tmp_path: Path) -> None:
    frame_decoder = motor(tmp_path)
    assert frame_decoder.warnings(2.0) == []
    assert_each_says(frame_decoder.warnings(4.0), ("Motor (0x181)", "not", "4.0 s"))
    cycle = 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\nBA_ "GenMsgCycleTime" BO_ 385 900;'
    seldom = decoder(tmp_path, WISHES, MOTOR + cycle)
    assert (seldom.warnings(0.0), seldom.warnings(8.9), len(seldom.warnings(9.1))) == ([], [], 1)
    slow = motor(tmp_path, messages={"Motor": {"period": "2 s"}})
    assert slow.warnings(19.0) == []
    assert_each_says(slow.warnings(21.0), ("Motor (0x181)", "not", "21.0 s"))
