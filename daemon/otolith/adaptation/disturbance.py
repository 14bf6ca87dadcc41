"""What disturbs a real machine between records, and the predictor that knows it.

Process noise comes from noisy inputs and from what strays in the states themselves. The Kalman gain weighs it against
the sensors' noise; with it the twin predicts in innovation form (L. Ljung, System Identification, 2nd ed., sections 4.3
and 7.4). Without process noise the gain is zero and the twin runs in open loop, the paper's cost.
"""

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.kernel import Correction, Excitation, Kernel, Noise


def predictor(kernel: Kernel, parameters: Array, initial: Array, excitation: Excitation, noise: Noise) -> Correction:
    """Along the window, around ``parameters`` (parameters,) and the initial state (states,).

    A twin that diverges there, or that nothing disturbs, runs in open loop.
    """
    if noise.inputs.any() or noise.states.any():
        found = kernel.correction(parameters, initial, excitation, noise)
        if np.isfinite(found.gain).all() and np.isfinite(found.whitening).all():
            return found
    return open_loop(kernel, excitation, noise)


def open_loop(kernel: Kernel, excitation: Excitation, noise: Noise) -> Correction:
    """Nothing is corrected, and each innovation is as uncertain as its sensor."""
    if excitation.measured is None:
        raise ValueError("a predictor needs measurements")
    present = np.isfinite(excitation.measured)
    scales = np.where(present, 1.0 / noise.outputs, 1.0)
    whitening = scales[:, :, None] * np.eye(len(noise.outputs))
    gain = np.zeros((len(excitation.inputs), len(kernel.definition.states), len(noise.outputs)))
    return Correction(gain, whitening, float(-2.0 * np.log(scales).sum()))
