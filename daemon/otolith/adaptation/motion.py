"""How a parameter moves between windows: its trend is a random process, its value the integral of it."""

import numpy as np

from otolith.acquisition.window import Array

MEMORY = 300.0  # s: a trend that nothing confirms dies away, so that no held value runs off


def motion(passed: float) -> tuple[Array, Array]:
    """Transition and noise (per unit of agitation) of value and trend over ``passed`` s.

    The trend is an Ornstein-Uhlenbeck process, the value its integral (C. W. Gardiner, Stochastic Methods, section
    3.8).
    """
    share = passed / MEMORY
    fade = np.exp(-share)
    run = MEMORY * -np.expm1(-share)
    if share < 1e-3:  # the closed form loses its digits
        noise = np.array([[passed**3 / 3.0, passed**2 / 2.0], [passed**2 / 2.0, passed]])
    else:
        both = MEMORY**2 * 0.5 * (1.0 - fade) ** 2
        value = MEMORY**3 * (share - 2.0 * (1.0 - fade) + 0.5 * (1.0 - fade**2))
        noise = np.array([[value, both], [both, MEMORY * 0.5 * (1.0 - fade**2)]])
    return np.array([[1.0, run], [0.0, fade]]), noise
