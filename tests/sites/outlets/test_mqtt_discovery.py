"""What Home Assistant reads of a machine: configurations as it documents them, availability, and their end."""

import json
import re
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from otolith.health.limits import Level
from otolith.outlet_tables import MqttOutlet
from otolith.site.outlets.base import MachineView, OutletSetup
from otolith.site.outlets.mqtt import MqttPublisher, build
from tests.hostile import HOSTILE
from tests.sites.machines import report_of
from tests.sites.outlets.rigs import MqttRig
from tests.waiting import wait_for

# Of https://www.home-assistant.io/integrations/sensor.mqtt: the keys that are used here, and what each may be.
DEVICE = {"identifiers": list, "name": str, "manufacturer": str, "model": str, "suggested_area": str}
ORIGIN = {"name": str, "sw_version": str}
SENSOR: dict[str, type | tuple[type, ...]] = {
    "device": dict, "origin": dict, "name": str, "unique_id": str, "state_topic": str, "value_template": str,
    "json_attributes_topic": str, "device_class": str, "options": list, "availability": list,
    "availability_mode": str, "state_class": str, "unit_of_measurement": str, "icon": str, "qos": int,
}  # fmt: skip
REQUIRED = {"state_topic", "unique_id", "device", "origin"}  # The last two of discovery with a device


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[MqttRig]:
    made = MqttRig(tmp_path)
    made.start()
    yield made
    made.stop()


@contextmanager
def publisher(rig: MqttRig, **options: Any) -> Iterator[MqttPublisher]:
    own = MqttOutlet(host="127.0.0.1", port=rig.port, **options)
    made = build(own, OutletSetup(rig.folder, "Works", "en"))
    try:
        yield made
    finally:
        made.close()


def view(machine: str = "press_1", *, is_silent: bool = False, **update: Any) -> MachineView:
    report = report_of(machine, end=time.time()).model_copy(update=update)
    state = Level.NO_DATA if is_silent else Level.OK
    return MachineView("hall", machine, state, str(state), time.time(), "well", "", None if is_silent else report, (1,))


def configurations(rig: MqttRig) -> dict[str, dict[str, Any]]:
    return {topic: json.loads(text) for topic, text in rig.retained().items() if topic.endswith("/config")}


def test_a_configuration_has_what_is_documented(rig: MqttRig) -> None:
    with publisher(rig) as outlet:
        outlet.send([view()], [], deque())
        found = configurations(rig)
        assert len(found) == 2
        for topic, own in found.items():
            assert re.fullmatch(r"homeassistant/sensor/[A-Za-z0-9_-]+/[A-Za-z0-9_-]+/config", topic)
            assert REQUIRED <= own.keys() <= SENSOR.keys()
            assert all(isinstance(value, SENSOR[name]) for name, value in own.items())
            assert own["device"].keys() <= DEVICE.keys()
            assert own["origin"].keys() <= ORIGIN.keys()
            assert (own.get("device_class") == "enum") == ("options" in own)
            assert not ("options" in own and ("state_class" in own or "unit_of_measurement" in own))
            assert all(each.keys() == {"topic"} for each in own["availability"])
        assert len({own["unique_id"] for own in found.values()}) == 2
        assert len({json.dumps(own["device"]) for own in found.values()}) == 1


def test_a_configuration_leads_to_the_value_that_it_names(rig: MqttRig) -> None:
    with publisher(rig) as outlet:
        outlet.send([view()], [], deque())
        retained = rig.retained()
        for own in configurations(rig).values():
            path = re.findall(r"\.(\w+)|\['(\w+)'\]", own["value_template"].partition("value_json")[2])
            value = json.loads(retained[own["state_topic"]])
            for step in path:
                value = value[step[0] or step[1]]
            assert value == "OK" if "options" in own else value == 6.5
            assert "options" not in own or value in own["options"]
            assert {retained[each["topic"]] for each in own["availability"]} == {b"online"}


def test_a_name_that_a_template_could_run_is_not_discovered(rig: MqttRig) -> None:
    parameter = report_of().parameters["R_a"]
    names = ["R_a", "x'] }}{{ states('sensor.secret') }}{{ ['", *(text for text in HOSTILE if len(text) < 1000)]
    with publisher(rig) as outlet:
        outlet.send([view(parameters=dict.fromkeys(names, parameter), twin="{{ 1 + 1 }}\n")], [], deque())
        assert {topic.split("/")[-2] for topic in configurations(rig)} == {"state", "R_a"}


def test_a_machine_that_is_silent_has_no_values_and_one_that_is_gone_has_no_topic(rig: MqttRig) -> None:
    with publisher(rig) as outlet:
        outlet.send([view("a"), view("b")], [], deque())
        outlet.send([view("a", is_silent=True)], ["hall/b"], deque())
        retained = rig.retained()
        assert retained["otolith/hall/a/availability"] == b"offline"
        assert not [topic for topic in retained if "/b/" in topic or "hall_-_b" in topic]


def test_a_machine_that_is_gone_after_a_lost_connection_has_no_topic(rig: MqttRig) -> None:
    with publisher(rig) as outlet:
        outlet.send([view("a"), view("b")], [], deque())
        outlet.close()  # as after a failure
        outlet.send([view("a")], ["hall/b"], deque())
        retained = rig.retained()
        assert not [topic for topic in retained if "/b/" in topic or "hall_-_b" in topic]
        assert json.loads(retained["otolith/hall/a/state"])["state"] == "OK"
        assert len(configurations(rig)) == 2


def test_a_parameter_that_is_gone_is_not_discovered_any_more(rig: MqttRig) -> None:
    parameter = report_of().parameters["R_a"]
    with publisher(rig) as outlet:
        outlet.send([view(parameters={"R_a": parameter, "D": parameter})], [], deque())
        outlet.send([view(parameters={"R_a": parameter})], [], deque())
        assert {topic.split("/")[-2] for topic in configurations(rig)} == {"state", "R_a"}


def test_a_parameter_with_the_name_of_the_state_has_a_sensor_of_its_own(rig: MqttRig) -> None:
    parameter = report_of().parameters["R_a"]
    names = ("state", "parameter_state", "R_a")
    with publisher(rig) as outlet:
        outlet.send([view(parameters=dict.fromkeys(names, parameter))], [], deque())
        found = configurations(rig)
        assert len(found) == len({own["unique_id"] for own in found.values()}) == 4
        assert sum("options" in own for own in found.values()) == 1
        outlet.send([], ["hall/press_1"], deque())
        assert configurations(rig) == {}


def test_after_the_end_of_the_site_nothing_is_known_of_its_machines(rig: MqttRig) -> None:
    with publisher(rig) as outlet:
        outlet.send([view("a"), view("b"), view("c")], [], deque())
        outlet.send([], ["hall/c"], deque())
    retained = rig.retained()
    for name in ("a", "b"):
        assert json.loads(retained[f"otolith/hall/{name}/state"])["state"] == "NO DATA"
        assert retained[f"otolith/hall/{name}/availability"] == b"offline"
    assert not [topic for topic in retained if "/c/" in topic]


def test_two_machines_have_two_ids(rig: MqttRig) -> None:
    with publisher(rig) as outlet:
        outlet.send([view("a_b"), view("a__b"), view("a-b")], [], deque())
        assert len({own["unique_id"] for own in configurations(rig).values()}) == 6


def test_who_reads_learns_that_the_site_is_away(rig: MqttRig) -> None:
    with publisher(rig, discovery=None) as outlet:
        outlet.send([view()], [], deque())
        assert rig.retained()["otolith/status"] == b"online"
        assert configurations(rig) == {}
    assert rig.retained()["otolith/status"] == b"offline"
    with publisher(rig) as outlet:
        outlet.send([view()], [], deque())
        connection = outlet._client
        assert connection is not None
        own = connection.socket()
        assert own is not None
        own.close()  # as a site that is killed
        wait_for(lambda: rig.retained()["otolith/status"] == b"offline")


def statuses(rig: MqttRig) -> list[bytes]:
    """What came of the status until now, to who was there before."""
    return [bytes(message.payload) for message in list(rig._received) if message.topic == "otolith/status"]


def test_who_was_cut_off_and_works_again_is_not_away_once_the_broker_notices(rig: MqttRig) -> None:
    with publisher(rig) as outlet:
        outlet.send([view()], [], deque())
        lost, outlet._client = outlet._client, None  # the broker still believes that it is there
        assert lost is not None
        outlet.send([view()], [], deque())
        lost.loop_stop()
        if (link := lost.socket()) is not None:
            link.close()
        wait_for(lambda: b"offline" in statuses(rig))
        assert rig.retained()["otolith/status"] == b"online"


def test_who_sends_is_not_away_because_another_one_has_ended(rig: MqttRig) -> None:
    with publisher(rig) as before, publisher(rig) as after:
        before.send([view()], [], deque())
        after.send([view()], [], deque())
        before.close()
        wait_for(lambda: b"offline" in statuses(rig))
        after.send([view()], [], deque())
        assert rig.retained()["otolith/status"] == b"online"
