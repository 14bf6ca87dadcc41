"""The example motor, simulated: no event while it is healthy, and each fault of the demo announced in words."""

from itertools import islice

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.health.limits import Level
from otolith.health.schema import EventChange, ReportDocument
from otolith.health.text import announcements
from otolith.machine import load_machine
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Gain, Offset, Step
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.conftest import EXAMPLES, SIGNALS
from tests.messages import assert_says

PERIOD, RECORDS = 0.01, 200


def reports(scenario: MotorScenario, count: int) -> list[ReportDocument]:
    machine = load_machine(EXAMPLES / "dc-motor.toml")
    state, documents, ticks = initial_state("m", "s", machine.problem, machine.plan), [], simulate(scenario)
    for index in range(count):
        rows = [[tick.measured[name] for name in SIGNALS.values()] for tick in islice(ticks, RECORDS)]
        window = Window.whole(index, index * PERIOD * RECORDS, PERIOD, tuple(SIGNALS), np.array(rows))
        state, report = adapt(state, window)
        documents.append(report.document)
    return documents


def motor(name: str) -> MotorScenario:
    scenario = load_scenario(EXAMPLES / "scenarios" / f"{name}.toml")
    assert isinstance(scenario, MotorScenario)
    return scenario


@pytest.mark.full
@pytest.mark.parametrize("seed", [1, 2])
def test_a_healthy_motor_has_no_event(seed: int) -> None:
    documents = reports(motor("demo").model_copy(update={"faults": (), "seed": seed}), 300)
    assert [event for document in documents for event in document.events] == []
    assert documents[-1].health is not None
    assert {part.state for part in documents[-1].health.parts.values()} == {Level.OK}


def test_the_demo_announces_winding_and_shaft_once_each_state() -> None:
    documents = reports(motor("demo"), 45)
    announced = [event for document in documents for event in announcements(document)]
    assert [(event.part, event.change, event.state) for event in announced] == [
        ("winding", EventChange.RAISED, Level.WATCH),
        ("shaft", EventChange.RAISED, Level.ACT),
        ("winding", EventChange.CHANGED, Level.ACT),
    ]
    winding, shaft = announced[2], announced[1]
    assert_says(winding.condition, "short circuit", "winding")
    assert shaft.condition == "unbalanced shaft"
    assert shaft.since == pytest.approx(45.0, abs=2.0)
    assert winding.since == pytest.approx(75.0, abs=3.0)  # from then on the injected resistance is below 95 %
    assert all(event.advice and event.source for event in announced)
    last = documents[-1].health
    assert last is not None
    assert (last.state, last.parts["winding"].state, last.parts["shaft"].state) == (Level.ACT, Level.ACT, Level.ACT)


def test_a_frozen_sensor_of_the_motor_is_one_event() -> None:
    documents = reports(motor("sensor-frozen"), 22)
    (event,) = [event for document in documents for event in announcements(document)]
    assert (event.part, event.state, event.condition) == ("sensors", Level.ACT, "a sensor is wrong")
    assert event.text.startswith("rotor speed: omega is frozen at ")


def test_a_sensor_that_works_again_leaves_no_other_event() -> None:
    keys = {"kind": "gain", "signal": "ArmatureCurrent", "factor": "1.1", "start": "20 s", "until": "40 s"}
    fault = Gain.model_validate(keys)
    documents = reports(motor("demo").model_copy(update={"faults": (fault,)}), 26)
    announced = [(event.part, event.change) for document in documents for event in announcements(document)]
    assert announced == [("sensors", EventChange.RAISED), ("sensors", EventChange.CLEARED)]
    assert WindowDecision.STEPPED not in {document.decision for document in documents}


@pytest.mark.full
@pytest.mark.parametrize(
    "fault",
    [
        Offset.model_validate({"kind": "offset", "signal": "ArmatureCurrent", "amount": "0.15 A", "start": "20 s"}),
        Step.model_validate({"kind": "step", "parameter": "R_a", "amount": "3.5 ohm", "start": "20 s"}),
    ],
    ids=lambda fault: fault.kind,
)
def test_a_steady_speed_is_no_limit_of_its_sensor(fault: Offset | Step) -> None:
    """Without its samples, the speed is what another fault makes of it; the class of causes ends when it is decided."""
    documents = reports(motor("demo").model_copy(update={"faults": (fault,)}), 32)
    assert "clipped" not in " ".join(finding.text for document in documents for finding in document.findings)
    (event,) = documents[-1].events
    assert event.part == ("sensors" if fault.kind == "offset" else "winding")


def test_a_weaker_magnet_is_an_event_although_the_machine_file_gives_it_as_known() -> None:
    step = Step.model_validate({"kind": "step", "parameter": "K_t", "start": "20 s", "amount": "-0.011 N*m/A"})
    documents = reports(motor("demo").model_copy(update={"faults": (step,)}), 25)
    (event,) = [event for document in documents for event in announcements(document)]
    assert (event.part, event.state) == ("magnets", Level.ACT)
    assert_says(event.condition, "magnetic field", "dropped")
