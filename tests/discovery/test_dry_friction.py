"""Dry friction is one component, whatever its rounding: no hump at rest is adopted beside it."""

import numpy as np
import pytest
from benchmarks.discovery.motor import Faults, simulate_motor, windows

from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.problem import Component, equation
from tests.discovery import two_mass
from tests.discovery.test_search import TWIN, initial, run
from tests.variants import often


@pytest.mark.parametrize("rounding", often([0.0], [0.0, 0.5]))
def test_dry_friction_of_a_reversing_motor_is_one_component(rounding: float) -> None:
    """Its speed crosses zero in every window; the friction is a step, or rounds off below 0.5 rad/s."""

    def torque(*moment: float) -> float:
        return -0.004 * float(np.sign(moment[-1]) if rounding == 0.0 else np.tanh(moment[-1] / rounding))

    record = windows(simulate_motor("reversing", 60.0, Faults(torque=torque, since=4.5), 3))
    _, documents = run(initial("R_a", "D"), record)
    # The load torque is proportional to the speed: where the friction rounds off, its sign leads until window 7.
    assert [len(document.components) for document in documents[9:]] == [1] * len(documents[9:])
    (component,) = documents[-1].components
    assert (component.family, component.input) == ("Coulomb", "omega")
    assert component.values["amplitude"].value == pytest.approx(-0.004, rel=0.03)


@pytest.mark.full
def test_dry_friction_on_the_load_of_two_masses_stays_alone_for_a_minute() -> None:
    """A hump of 0.02 N*m was adopted beside 0.3 N*m, as the friction rounds off below 0.02 rad/s."""
    state, documents = initial_state("m", "here", two_mass.problem("J_l", "D_l")), []
    for window in two_mass.simulate(60.0, two_mass.DryFriction(since=6.0)):
        state, report = adapt(state, window)
        documents.append(report.document)
    (component,) = documents[-1].components
    assert component.id == "load_side/Coulomb/omega_l"
    assert component.values["amplitude"].value == pytest.approx(-0.3, rel=0.02)
    assert {item.id for document in documents for item in document.components} == {component.id}


@pytest.mark.parametrize("phase", [1.5 - 2.0 * np.pi, 1.5, 1.5 + 14.0 * np.pi])
def test_a_phase_is_written_within_one_turn(phase: float) -> None:
    """The filter lets it grow: a reader would take each turn for a change."""
    component = Component("shaft", "periodic", "t", 0.001, 20.0, phase)
    assert equation(TWIN, component, [0.001, 20.0, phase]) == "0.001·sin(20·t + 1.50) N*m"


def test_a_negative_rate_is_written_with_one_sign() -> None:
    component = Component("shaft", "negative exponential", "i", 0.001, 0.1)
    assert equation(TWIN, component, [0.001, -0.0008]) == "0.001·exp(0.0008·i) N*m"
