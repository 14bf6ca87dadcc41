"""Faults of sensors and bus of the simulated machine, its register map, and their documentation."""

import tomllib
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.modbus.options import Order
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import (
    BusEffect,
    BusFault,
    ClockStep,
    Dropouts,
    Fault,
    FaultInjector,
    Frozen,
    Gain,
    Garbage,
    Gone,
    Jitter,
    Offset,
    PlantSample,
    Refusal,
    SensorFault,
    Spikes,
    WordOrder,
)
from otolith_drivers.plant.realtime import NODES, NodeSummary, ScheduledSample, in_real_time, refuse_unfit
from otolith_drivers.plant.scenario import NodeModbusOptions, RegisterMap, load_scenario, simulate
from tests.conftest import EXAMPLES

PERIOD = 0.01
SECONDS = 20.0
HALF = Dropouts(kind="dropouts", share=0.5, start="1 s", until="3 s")
AWAY = Gone(kind="gone", start="2 s", until="2.5 s")
OTHERS = (
    Jitter(kind="jitter", deviation="2 ms", start="0 s"),
    ClockStep(kind="clock_step", by="-0.5 s", start="1 s"),
    Garbage(kind="garbage", share=0.1, start="0 s"),
    WordOrder(kind="word_order", order="CDAB", start="1 s"),
    Refusal(kind="exception", code=6, start="0 s"),
)
FAULTS = st.lists(st.sampled_from([HALF, AWAY, *OTHERS]), max_size=4)


def samples_of(scenario: MotorScenario, *faults: Fault) -> list[PlantSample]:
    changed = scenario.model_copy(update={"faults": (*scenario.faults, *faults)})
    return list(islice(simulate(changed), round(SECONDS / PERIOD)))


def column(samples: list[PlantSample], name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([sample.measured[name] for sample in samples])


SENSOR_FAULTS: dict[str, SensorFault] = {
    "frozen": Frozen(kind="frozen", signal="RotorSpeed", start="5 s", until="8 s"),
    "gain": Gain(kind="gain", signal="RotorSpeed", factor=1.1, start="5 s", until="8 s"),
    "offset": Offset(kind="offset", signal="RotorSpeed", amount="10 rpm", start="5 s", until="8 s"),
    "spikes": Spikes(kind="spikes", signal="RotorSpeed", amount="50 rad/s", share=0.2, start="5 s", until="8 s"),
}


@pytest.mark.parametrize("kind", SENSOR_FAULTS)
def test_sensor_fault_changes_the_bus_value_only(scenario: MotorScenario, kind: str) -> None:
    """Truth, voltage and the other sensors are bit-identical to those without the fault."""
    right, wrong = samples_of(scenario), samples_of(scenario, SENSOR_FAULTS[kind])
    for one, other in zip(right, wrong, strict=True):
        assert one.truth == other.truth
        assert {**other.measured, "RotorSpeed": one.measured["RotorSpeed"]} == one.measured
    was, is_ = column(right, "RotorSpeed"), column(wrong, "RotorSpeed")
    assert np.array_equal(was[:500], is_[:500])
    assert np.array_equal(was[800:], is_[800:])
    inside, error = was[500:800], (is_ - was)[500:800]
    if kind == "frozen":
        assert np.all(is_[500:800] == inside[0])
    if kind == "gain":
        assert np.allclose(error, 0.1 * inside, rtol=1e-12)
    if kind == "offset":
        assert np.allclose(error, 10.0 * 2.0 * np.pi / 60.0)
    if kind == "spikes":
        assert set(np.round(error, 9)) == {-50.0, 0.0, 50.0}
        assert np.count_nonzero(error) == pytest.approx(60, abs=4 * (300 * 0.2 * 0.8) ** 0.5)


def test_sensor_faults_of_a_signal_act_in_file_order(scenario: MotorScenario) -> None:
    frozen, gain = SENSOR_FAULTS["frozen"], SENSOR_FAULTS["gain"]
    right = column(samples_of(scenario), "RotorSpeed")
    assert column(samples_of(scenario, frozen, gain), "RotorSpeed")[799] == pytest.approx(1.1 * right[500])
    doubled = Gain(kind="gain", signal="RotorSpeed", factor=2.0, start="0 s")
    assert column(samples_of(scenario, doubled, frozen), "RotorSpeed")[799] == 2.0 * right[500]


def effects(faults: Sequence[BusFault], seed: int = 1, count: int = 400) -> list[BusEffect]:
    injector = FaultInjector(faults, seed)
    return [injector.at(index * PERIOD) for index in range(count)]


@given(FAULTS, st.integers(0, 2**31), st.sampled_from([HALF, AWAY]))
def test_bus_faults_have_independent_random_numbers(faults: list[BusFault], seed: int, another: BusFault) -> None:
    """The same seed gives the same faults, and another fault does not change those before it."""
    before, after = effects(faults, seed), effects([*faults, another], seed)
    assert before == effects(faults, seed)
    for one, other in zip(before, after, strict=True):
        assert other.acting[: len(one.acting)] == one.acting
        assert (other.delay, other.order, other.garbage) == (one.delay, one.order, one.garbage)


@given(FAULTS)
def test_bus_fault_acts_only_in_its_span(faults: list[BusFault]) -> None:
    for index, effect in enumerate(effects(faults)):
        for number in effect.acting:
            assert faults[number].covers(index * PERIOD)
        assert effect.gone == any(isinstance(fault, Gone) and 200 <= index < 250 for fault in faults)
        if effect.gone:
            assert effect.withheld is not None


def test_dropouts_of_two_seeds_differ_but_are_as_many() -> None:
    lost = [[effect.withheld is not None for effect in effects([HALF], seed)] for seed in (1, 2)]
    assert lost[0] != lost[1]
    for is_lost in lost:
        assert sum(is_lost) == sum(is_lost[100:300]) == pytest.approx(100, abs=4 * (200 * 0.25) ** 0.5)


def test_jitter_has_its_deviation_and_is_never_early() -> None:
    faults = [Jitter(kind="jitter", deviation="2 ms", start="0 s")]
    delays = np.array([effect.delay for effect in effects(faults, count=4000)])
    assert delays.std() == pytest.approx(0.002, rel=0.05)
    assert delays.min() >= 0.0


def test_fault_is_refused_on_a_transport_that_cannot_have_it() -> None:
    scenario = load_scenario(EXAMPLES / "scenarios" / "word-order.toml")
    for transport in ("can", "in-process"):
        with pytest.raises(ConfigurationError, match=r"faults\[0\].*'word_order' cannot happen on"):
            refuse_unfit(scenario, transport)
    refuse_unfit(scenario, "modbus-tcp")
    assert set(NODES) == {"can", "modbus-tcp", "modbus-rtu"}


def test_a_fault_of_one_bus_leaves_the_other_alone() -> None:
    scenario = load_scenario(EXAMPLES / "scenarios" / "two-buses.toml")
    summaries = {transport: NodeSummary.of(scenario.faults) for transport in ("can", "modbus-tcp")}
    sent: dict[str, list[ScheduledSample]] = {transport: [] for transport in summaries}
    for transport, scheduled in in_real_time(scenario, summaries, lambda: False, 0.3):
        sent[transport].append(scheduled)
    assert [item.sample for item in sent["can"]] == [item.sample for item in sent["modbus-tcp"]]
    assert len(sent["can"]) == summaries["can"].ticks == 30
    assert {round(item.due - item.taken, 9) for item in sent["can"]} == {0.0}
    late = [item.due - item.taken for item in sent["modbus-tcp"]]
    assert np.mean(late) == pytest.approx(0.020, abs=0.004)
    assert [fault.ticks for fault in summaries["can"].faults.values()] == [0, 0, 0, 0]
    assert [fault.ticks for fault in summaries["modbus-tcp"].faults.values()] == [30, 30, 0, 0]


def test_docs_have_every_fault_and_every_modbus_default() -> None:
    page = (Path(__file__).parents[3] / "docs" / "simulated-machines.md").read_text(encoding="utf-8")
    rows = {line.split("`")[1]: line for line in page.splitlines() if line.startswith("| `")}
    classes = {get_args(each.model_fields["kind"].annotation)[0]: each for each in get_args(get_args(Fault)[0])}
    assert rows.keys() == classes.keys()
    for kind, each in classes.items():
        fields = set(each.model_fields) - {"kind", "start", "until", "on"}
        assert {name for name in fields if f"`{name}`" not in rows[kind]} == set()
    written = tomllib.loads(page.split("```toml")[1].split("```")[0])["modbus"]
    assert NodeModbusOptions.model_validate(written) == NodeModbusOptions()
    assert {"scale", "line", *written} == set(NodeModbusOptions.model_fields)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ('kind = "gain"\nsignal = "RotorSped"\nfactor = 2', "did you mean 'RotorSpeed'"),
        ('kind = "offset"\nsignal = "RotorSpeed"\namount = "2 A"', "does not measure what 'rad/s' does"),
        ('kind = "gone"\nuntil = "0 s"', "must be later than start"),
        ('kind = "dropouts"\nshare = 2', "between 0 and 1"),
        ('kind = "exception"\ncode = 2\nfirst = 3\nlast = 2', "must not be below first"),
        ('kind = "clock_step"\nby = "2 min"', "between -60 and 60 s"),
        ('kind = "gonne"', "gone"),
    ],
)
def test_wrong_fault_is_refused_with_the_reason(tmp_path: Path, wrong: str, message: str) -> None:
    text = (EXAMPLES / "scenarios" / "sensor-gain.toml").read_text(encoding="utf-8")
    path = tmp_path / "wrong.toml"
    path.write_text(f'{text.split("[[faults]]")[0]}\n[[faults]]\n{wrong}\nstart = "0 s"\n', encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message):
        load_scenario(path)


SIGNALS = {"speed": "rad/s", "current": "A"}
BYTES = {"ABCD": [0, 1, 2, 3], "DCBA": [3, 2, 1, 0], "BADC": [1, 0, 3, 2], "CDAB": [2, 3, 0, 1]}


@given(
    st.floats(width=32, allow_nan=False, allow_infinity=False),
    st.floats(-1e4, 1e4),
    st.integers(0, 2**20),
    st.sampled_from(sorted(BYTES)),
)
def test_register_map_encodes_floats_in_any_order(one: float, other: float, index: int, order: Order) -> None:
    registers = RegisterMap(NodeModbusOptions(), SIGNALS).encode({"speed": one, "current": other}, index, order)
    assert registers[4] == index % 65536
    data = np.array(registers[:4], ">u2").view("u1").reshape(2, 4)[:, np.argsort(BYTES[order])]
    assert np.array_equal(np.ascontiguousarray(data).view(">f4").ravel(), np.array([one, other], np.float32))


@pytest.mark.parametrize(("kind", "low", "high"), [("int16", -(2**15), 2**15 - 1), ("int32", -(2**31), 2**31 - 1)])
def test_register_map_scales_and_saturates_integers(kind: str, low: int, high: int) -> None:
    options = NodeModbusOptions.model_validate({"type": kind, "scale": {"speed": "1 rpm", "current": "1 mA"}})
    registers = RegisterMap(options, SIGNALS)

    def read(current: float) -> int:
        words = registers.encode({"speed": 0.0, "current": current}, 0, "ABCD")[2:4]
        return int(np.array(words, ">u2").view(">i4" if kind == "int32" else ">i2")[0])

    assert [read(value) for value in (2.0014, -0.0026, 1e9, -1e9)] == [2001, -3, high, low]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"type": "int16"}, "needs modbus.scale of speed, current"),
        ({"type": "int16", "scale": {"speed": "1 rpm", "curent": "1 A"}}, "'curent', which is no signal"),
        ({"type": "int16", "scale": {"speed": "1 A", "current": "1 A"}}, "does not measure"),
        ({"type": "int16", "scale": {"speed": "1 rpm", "current": "0 A"}}, "above zero"),
        ({"scale": {"speed": "1 rpm"}}, 'scale is for type = "int16"'),
    ],
)
def test_register_map_refuses_wrong_options(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RegisterMap(NodeModbusOptions.model_validate(options), SIGNALS)
