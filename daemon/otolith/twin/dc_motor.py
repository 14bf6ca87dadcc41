"""The permanent-magnet DC motor of paper.txt section 4.1, in continuous time (Eq. 4, and Eq. 12 for the signs).

States i (A) and omega (rad/s); inputs V_a (V), a command held for a record, and T_load (N·m), measured.
"""

import numba
import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.model import Input, Output, Parameter, Twin

SUBSTEPS = 2  # per record of 10 ms: truncation error below 1e-8 of the range with the time constants of Table 3


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _simulate(parameters: Array, initial: Array, inputs: Array, sample_period: float) -> Array:
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


DC_MOTOR = Twin(
    name="dc_motor",
    title="permanent-magnet DC motor",
    source="An Interpretable Digital Twin for Self-Aware Industrial Machines (2023), Eq. 4, 11, 12 and Table 3",
    parameters=(
        Parameter("R_a", "ohm", 6.5, 3.0, 12.0, "armature resistance"),
        Parameter("L_a", "H", 0.673, 0.2, 2.0, "armature inductance"),
        Parameter("J", "kg*m^2", 0.001171, 0.0003, 0.005, "moment of inertia of the rotor"),
        Parameter("K_e", "V*s/rad", 0.038, 0.01, 0.15, "electromotive force constant"),
        Parameter("K_t", "N*m/A", 0.038, 0.01, 0.15, "torque constant"),
        Parameter("D", "N*m*s/rad", 0.00143, 0.0, 0.01, "viscous damping coefficient of the rotor"),
    ),
    inputs=(
        Input("V_a", "V", "armature voltage", "zoh"),
        Input("T_load", "N*m", "load torque", "foh"),
    ),
    outputs=(
        Output("i", "A", "armature current", 0.005),
        Output("omega", "rad/s", "rotor speed", 0.02),
    ),
    states=("i", "omega"),
    equations=("der(i) = (V_a - R_a*i - K_e*omega) / L_a", "der(omega) = (K_t*i - T_load - D*omega) / J"),
    simulate=_simulate,
)
