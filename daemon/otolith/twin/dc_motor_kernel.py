"""The compiled kernel of :mod:`otolith.twin.dc_motor`; importing it loads numba."""

import numba
import numpy as np

from otolith.acquisition.window import Array

SUBSTEPS = 2  # per record of 10 ms: truncation error below 1e-8 of the range with the time constants of Table 3


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def simulate(parameters: Array, initial: Array, inputs: Array, sample_period: float) -> Array:
    """See :data:`otolith.twin.model.Simulate`."""
    particles, records = parameters.shape[0], inputs.shape[0]
    outputs = np.empty((particles, records, 2))
    h = sample_period / SUBSTEPS
    for particle in range(particles):
        R_a, L_a, J, K_e, K_t, D = parameters[particle]
        i, w = initial[particle]
        for record in range(records):
            outputs[particle, record, 0] = i
            outputs[particle, record, 1] = w
            following = min(record + 1, records - 1)
            V = inputs[record, 0]
            slope = (inputs[following, 1] - inputs[record, 1]) / SUBSTEPS
            for substep in range(SUBSTEPS):
                T0 = inputs[record, 1] + slope * substep
                T1, T2 = T0 + slope / 2, T0 + slope
                i1 = (V - R_a * i - K_e * w) / L_a
                w1 = (K_t * i - T0 - D * w) / J
                ia, wa = i + h / 2 * i1, w + h / 2 * w1
                i2 = (V - R_a * ia - K_e * wa) / L_a
                w2 = (K_t * ia - T1 - D * wa) / J
                ia, wa = i + h / 2 * i2, w + h / 2 * w2
                i3 = (V - R_a * ia - K_e * wa) / L_a
                w3 = (K_t * ia - T1 - D * wa) / J
                ia, wa = i + h * i3, w + h * w3
                i4 = (V - R_a * ia - K_e * wa) / L_a
                w4 = (K_t * ia - T2 - D * wa) / J
                i += h / 6 * (i1 + 2 * i2 + 2 * i3 + i4)
                w += h / 6 * (w1 + 2 * w2 + 2 * w3 + w4)
    return outputs
