"""The DC motor as a hand-written Numba kernel: the reference for generated kernels."""

import numba
import numpy as np

from otolith.acquisition.window import Array

SUBSTEPS = 2  # per record of 10 ms: truncation error below 1e-8 of the range with the time constants of Table 3


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def simulate(parameters: Array, initial: Array, inputs: Array, sample_period: float) -> Array:
    """As otolith.twin.kernel.Kernel.simulate."""
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


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def sensitivities(parameters: Array, initial: Array, inputs: Array, sample_period: float) -> tuple[Array, Array]:
    """One trajectory and its derivatives by R_a, L_a, J, K_e and K_t, by the variational equations."""
    records = inputs.shape[0]
    outputs, slopes = np.empty((records, 2)), np.empty((records, 2, 5))
    h = sample_period / SUBSTEPS
    R_a, L_a, J, K_e, K_t, D = parameters
    i, w = initial
    a = -R_a / L_a
    b = -K_e / L_a
    c = K_t / J
    d = -D / J
    si, sw = np.zeros(5), np.zeros(5)
    fi, fw = np.zeros((4, 5)), np.zeros((4, 5))
    for record in range(records):
        outputs[record, 0] = i
        outputs[record, 1] = w
        for k in range(5):
            slopes[record, 0, k] = si[k]
            slopes[record, 1, k] = sw[k]
        following = min(record + 1, records - 1)
        V = inputs[record, 0]
        slope = (inputs[following, 1] - inputs[record, 1]) / SUBSTEPS
        for substep in range(SUBSTEPS):
            T0 = inputs[record, 1] + slope * substep
            T1, T2 = T0 + slope / 2, T0 + slope
            i1 = (V - R_a * i - K_e * w) / L_a
            w1 = (K_t * i - T0 - D * w) / J
            ib, wb = i + h / 2 * i1, w + h / 2 * w1
            i2 = (V - R_a * ib - K_e * wb) / L_a
            w2 = (K_t * ib - T1 - D * wb) / J
            ic, wc = i + h / 2 * i2, w + h / 2 * w2
            i3 = (V - R_a * ic - K_e * wc) / L_a
            w3 = (K_t * ic - T1 - D * wc) / J
            ie, we = i + h * i3, w + h * w3
            i4 = (V - R_a * ie - K_e * we) / L_a
            w4 = (K_t * ie - T2 - D * we) / J
            fi[0, 0], fi[1, 0], fi[2, 0], fi[3, 0] = -i / L_a, -ib / L_a, -ic / L_a, -ie / L_a
            fi[0, 1], fi[1, 1], fi[2, 1], fi[3, 1] = -i1 / L_a, -i2 / L_a, -i3 / L_a, -i4 / L_a
            fw[0, 2], fw[1, 2], fw[2, 2], fw[3, 2] = -w1 / J, -w2 / J, -w3 / J, -w4 / J
            fi[0, 3], fi[1, 3], fi[2, 3], fi[3, 3] = -w / L_a, -wb / L_a, -wc / L_a, -we / L_a
            fw[0, 4], fw[1, 4], fw[2, 4], fw[3, 4] = i / J, ib / J, ic / J, ie / J
            for k in range(5):
                p, q = si[k], sw[k]
                p1 = a * p + b * q + fi[0, k]
                q1 = c * p + d * q + fw[0, k]
                p2 = a * (p + h / 2 * p1) + b * (q + h / 2 * q1) + fi[1, k]
                q2 = c * (p + h / 2 * p1) + d * (q + h / 2 * q1) + fw[1, k]
                p3 = a * (p + h / 2 * p2) + b * (q + h / 2 * q2) + fi[2, k]
                q3 = c * (p + h / 2 * p2) + d * (q + h / 2 * q2) + fw[2, k]
                p4 = a * (p + h * p3) + b * (q + h * q3) + fi[3, k]
                q4 = c * (p + h * p3) + d * (q + h * q3) + fw[3, k]
                si[k] = p + h / 6 * (p1 + 2 * p2 + 2 * p3 + p4)
                sw[k] = q + h / 6 * (q1 + 2 * q2 + 2 * q3 + q4)
            i += h / 6 * (i1 + 2 * i2 + 2 * i3 + i4)
            w += h / 6 * (w1 + 2 * w2 + 2 * w3 + w4)
    return outputs, slopes
