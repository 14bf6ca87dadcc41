"""What a host of Sparkplug B sees of a node: births, changes, deaths, numbers, units; read by the official schema."""

import shutil
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tahutils.tahu.sparkplug_b_pb2 import Payload

from otolith.health.limits import Level
from otolith.health.schema import Status
from otolith.outlet_tables import SparkplugOutlet
from otolith.site.outlets.base import MachineView, OutletError, OutletSetup
from otolith.site.outlets.sparkplug import SparkplugNode, build
from otolith_drivers.grammars.sparkplug_payload import DataType, SparkplugMetric, asks_for_rebirth, payload
from tests.drivers.mqtt_broker import mqtt_broker
from tests.messages import raises_saying
from tests.sites.machines import report_of
from tests.sites.outlets.rigs import SparkplugRig, metrics_of
from tests.waiting import wait_for

UNIT, QUALITY = "engUnit", "Quality"


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[SparkplugRig]:
    made = SparkplugRig(tmp_path)
    made.start()
    yield made
    made.stop()


@contextmanager
def node(rig: SparkplugRig, sender: str = "") -> Iterator[SparkplugNode]:
    made = build(
        SparkplugOutlet(host="127.0.0.1", port=rig.port), OutletSetup(rig.folder, "Works", "en", sender=sender)
    )
    try:
        yield made
    finally:
        made.close()


def view(machine: str = "press_1", value: float = 6.5, *, is_silent: bool = False, **update: Any) -> MachineView:
    report = report_of(machine, end=time.time(), value=value)
    row = report.parameters["R_a"].model_copy(update=update)
    report = report.model_copy(update={"parameters": {"R_a": row}})
    state = Level.NO_DATA if is_silent else Level.OK
    return MachineView("hall", machine, state, str(state), 1e9, "well", "", None if is_silent else report, (1,))


def kinds(rig: SparkplugRig) -> list[str]:
    return [f"{kind} {device}".strip() for kind, device, _ in rig.messages]


def properties_of(metric: Any) -> dict[str, Any]:
    values = metric.properties.values
    return {key: getattr(value, value.WhichOneof("value"))
            for key, value in zip(metric.properties.keys, values, strict=True)}  # fmt: skip


def test_a_connection_begins_with_births_and_sends_what_changes(rig: SparkplugRig) -> None:
    with node(rig) as outlet:
        outlet.send([view(), view("press_2")], [], deque())
        outlet.send([view(value=6.6)], [], deque())
        outlet.send([view(value=6.6)], [], deque())  # nothing has changed
        outlet.send([view(is_silent=True)], [], deque())
        outlet.send([view(value=6.7)], ["hall/press_2"], deque())
    first = ["NBIRTH", "DBIRTH hall.press_1", "DBIRTH hall.press_2", "NDATA", "DDATA hall.press_1"]
    later = ["DDEATH hall.press_1", "NDATA", "DBIRTH hall.press_1", "DDEATH hall.press_2", "NDEATH"]
    wait_for(lambda: kinds(rig) == [*first, *later])
    messages = [content for _, _, content in rig.messages]
    assert [content.seq for content in messages[:-1]] == list(range(len(messages) - 1))
    assert not messages[-1].HasField("seq")  # a death has none
    born, died = metrics_of(messages[0]), metrics_of(messages[-1])
    assert born["bdSeq"].long_value == died["bdSeq"].long_value
    assert not born["Node Control/Rebirth"].boolean_value
    changed = metrics_of(messages[4])
    assert set(changed) == {f"Parameters/R_a/{name}" for name in ("Value", "Low", "High")}
    assert changed["Parameters/R_a/Value"].double_value == 6.6
    assert not any(message.retain for message in rig._received)


def test_a_birth_has_types_units_and_quality_of_each_value(rig: SparkplugRig) -> None:
    with node(rig) as outlet:
        outlet.send([view(limit=None), view("press_2", status=Status.HELD)], [], deque())
        wait_for(lambda: len(rig.messages) >= 3)
        born, other = (metrics_of(content) for _, _, content in rig.messages[1:3])
    value, limit = born["Parameters/R_a/Value"], born["Parameters/R_a/Limit"]
    assert (value.datatype, value.double_value) == (DataType.DOUBLE, 6.5)
    assert properties_of(value) == {UNIT: "ohm", QUALITY: 192}
    assert properties_of(other["Parameters/R_a/Value"]) == {UNIT: "ohm", QUALITY: 500}
    assert (limit.is_null, properties_of(limit)) == (True, {UNIT: "ohm"})
    assert (born["State"].string_value, born["Since"].datatype) == ("OK", DataType.DATE_TIME)
    assert born["Since"].long_value == 1_000_000_000_000
    assert abs(value.timestamp - 1e3 * time.time()) < 60e3


def test_a_host_that_asks_gets_all_births_again(rig: SparkplugRig) -> None:
    with node(rig) as outlet:
        outlet.send([view(), view("press_2")], [], deque())
        client, is_subscribed = rig.subscriber([])
        wait_for(is_subscribed.is_set)
        rig.command(client, "spBv1.0/otolith/NCMD/site")

        def is_born_again() -> bool:
            outlet.send([], [], deque())
            return kinds(rig).count("NBIRTH") == 2 and len([1 for kind in kinds(rig) if "DBIRTH" in kind]) == 4

        wait_for(is_born_again)
        client.disconnect()
        client.loop_stop()
        again = [row for row in rig.messages if row[0] in ("NBIRTH", "DBIRTH")][-3:]
    assert [content.seq for _, _, content in again] == [0, 1, 2]
    (first, second) = [metrics_of(content)["bdSeq"] for kind, _, content in rig.messages if kind == "NBIRTH"]
    assert first.long_value == second.long_value  # it is the same connection


def test_a_node_that_is_cut_off_is_dead_and_the_next_has_another_number(rig: SparkplugRig) -> None:
    with node(rig, "hall/press_1") as outlet:
        outlet.send([view()], [], deque())
        assert outlet._client is not None
        outlet._client.loop_stop()
        outlet._client.socket().close()  # type: ignore[union-attr]  # as a process that is killed
        wait_for(lambda: "NDEATH" in kinds(rig))
        died = metrics_of(rig.messages[-1][2])["bdSeq"].long_value
        assert died == metrics_of(rig.messages[0][2])["bdSeq"].long_value
        outlet._client.loop_read()
        outlet.send([], [], deque())
        wait_for(lambda: kinds(rig)[-2:] == ["NBIRTH", "DBIRTH hall.press_1"])
        assert metrics_of(rig.messages[-2][2])["bdSeq"].long_value == (died + 1) % 256
    assert {message.topic.split("/")[3] for message in rig._received} == {"hall.press_1"}


@pytest.mark.skipif(shutil.which("mosquitto") is None, reason="only mosquitto has such an access list here")
def test_a_node_that_may_not_hear_commands_fails_and_says_so(tmp_path: Path) -> None:
    rig = SparkplugRig(tmp_path)
    with mqtt_broker(rig.port, tmp_path, may_subscribe=False), node(rig) as outlet:
        for _ in range(2):
            with raises_saying(OutletError, "127.0.0.1", "spBv1.0/otolith/NCMD/site", "access list of the broker"):
                outlet.send([view()], [], deque())


VALUES = st.one_of(
    st.tuples(st.just(DataType.INT64), st.integers(0, 2**63 - 1)),
    st.tuples(st.just(DataType.INT32), st.integers(0, 2**31 - 1)),
    st.tuples(st.just(DataType.DOUBLE), st.floats(allow_nan=False)),
    st.tuples(st.just(DataType.BOOLEAN), st.booleans()),
    st.tuples(st.sampled_from(DataType), st.none()),
    st.tuples(st.just(DataType.STRING), st.text()),
)


@given(name=st.text(), typed=VALUES, properties=st.dictionaries(st.text(), VALUES.filter(lambda row: row[0] != 13)))
def test_what_is_written_is_read_by_the_official_schema(name: str, typed: Any, properties: dict[str, Any]) -> None:
    metric = SparkplugMetric(name, typed[0], typed[1], 7, properties)
    read = Payload.FromString(payload([metric, metric], 5, 255))
    assert (read.timestamp, read.seq, len(read.metrics)) == (5, 255, 2)
    (own, _) = read.metrics
    assert (own.name, own.datatype, own.timestamp, own.is_null) == (name, typed[0], 7, typed[1] is None)
    assert own.WhichOneof("value") is None or getattr(own, own.WhichOneof("value")) == typed[1]
    assert list(own.properties.keys) == list(properties)
    for (_, value), found in zip(properties.values(), own.properties.values, strict=True):
        assert found.is_null if value is None else getattr(found, found.WhichOneof("value")) == value


@given(content=st.binary(max_size=200))
def test_no_command_that_cannot_be_read_asks_for_anything(content: bytes) -> None:
    assert not asks_for_rebirth(content)


def test_only_the_command_asks_for_births() -> None:
    for name, value, is_asked in (("Node Control/Rebirth", True, True), ("Node Control/Rebirth", False, False),
                                  ("Node Control/Reboot", True, False)):  # fmt: skip
        command = Payload(timestamp=1)
        command.metrics.add(name="x", datatype=3, int_value=5)
        command.metrics.add(name=name, datatype=11, boolean_value=value)
        assert asks_for_rebirth(command.SerializeToString()) is is_asked
