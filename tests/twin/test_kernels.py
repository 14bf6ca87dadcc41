"""Compiled kernels against an independent integrator, and their order."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from otolith.acquisition.window import Array
from otolith.twin.dc_motor import DC_MOTOR

PERIOD, RECORDS = 0.01, 200


def inputs() -> Array:
    """A voltage that jumps and a load torque that swings."""
    time = np.arange(RECORDS) * PERIOD
    return np.column_stack([np.where(time < 0.7, 12.0, 5.0), 0.05 + 0.02 * np.sin(9.0 * time)])


def nominal() -> Array:
    return np.array([entry.nominal for entry in DC_MOTOR.parameters])


def reference(parameters: Array, initial: Array, driven: Array) -> Array:
    """Record by record with a tight tolerance: voltage held, load torque straight between records."""
    R_a, L_a, J, K_e, K_t, D = parameters  # noqa: N806
    states = [initial]
    for record in range(RECORDS - 1):
        voltage, torques = driven[record, 0], driven[record : record + 2, 1]

        def rates(t: float, x: Array, voltage: float = voltage, torques: Array = torques) -> list[float]:
            torque = torques[0] + (torques[1] - torques[0]) * t / PERIOD
            return [(voltage - R_a * x[0] - K_e * x[1]) / L_a, (K_t * x[0] - torque - D * x[1]) / J]

        states.append(solve_ivp(rates, (0.0, PERIOD), states[-1], rtol=1e-12, atol=1e-13).y[:, -1])
    return np.array(states)


def test_agrees_with_an_independent_integrator() -> None:
    initial = np.array([0.3, 4.0])
    found = DC_MOTOR.simulate(nominal()[None], initial[None], inputs(), PERIOD)[0]
    expected = reference(nominal(), initial, inputs())
    assert np.abs(found - expected).max(axis=0) == pytest.approx(0.0, abs=1e-6 * np.ptp(expected, axis=0).min())


def test_order_four() -> None:
    """Halving the step (half the period, every input twice) divides the error by sixteen."""
    driven = np.column_stack([np.full(40, 12.0), np.zeros(40)])
    coarse, fine, finest = (
        DC_MOTOR.simulate(nominal()[None], np.zeros((1, 2)), np.repeat(driven, n, axis=0), 0.08 / n)[0, ::n][:40]
        for n in (1, 2, 16)
    )
    ratio = np.abs(coarse - finest).max() / np.abs(fine - finest).max()
    assert np.log2(ratio) == pytest.approx(4.0, abs=0.3)


def test_a_swarm_is_its_particles_one_by_one() -> None:
    random = np.random.default_rng(1)
    swarm = nominal() * random.uniform(0.8, 1.2, (15, len(nominal())))
    initial = random.normal(size=(15, 2))
    together = DC_MOTOR.simulate(swarm, initial, inputs(), PERIOD)
    alone = [DC_MOTOR.simulate(swarm[k : k + 1], initial[k : k + 1], inputs(), PERIOD)[0] for k in range(15)]
    assert np.array_equal(together, np.array(alone))
