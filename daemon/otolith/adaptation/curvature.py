"""How far the linear picture of a window holds: what bends within the interval is not known to the last digit.

Parameters that are traded lie on a long ridge, and a ridge bends. Around its best point the window seems to know some
combination of them far better than it does, because the combination changes along the ridge. The second-order change of
the residuals, one standard deviation away in every direction, is therefore counted as noise (the modified Gaussian
second-order filter: A. H. Jazwinski, Stochastic Processes and Filtering Theory, section 9.3).
"""

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.objective import Objective

SLIGHT = 1e-12  # relative eigenvalue of a direction that is not uncertain at all


def bends(objective: Objective, guess: Array, jacobian: Array) -> Array:
    """(residuals, directions) second-order change of the residuals, one standard deviation from ``guess`` (guess,).

    ``jacobian`` (rows, guess) is of everything that holds the guess in place, the prior included.
    """
    if not np.isfinite(jacobian).all():
        return np.zeros((len(objective.measured.ravel()), 0))
    size = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    _, singular, directions = np.linalg.svd(jacobian / size, full_matrices=False)
    seen = singular > SLIGHT * singular[0]
    steps = directions[seen] / singular[seen, None] / size
    around = np.vstack([guess + steps, guess - steps, guess[None]])
    inside = np.clip(around, objective.low, objective.high)
    with np.errstate(over="ignore", invalid="ignore"):
        found = objective.residuals(objective.predict(inside)).reshape(len(around), -1)
        count = len(steps)
        change = 0.5 * (found[:count] + found[count : 2 * count]) - found[-1]
    return np.where(np.isfinite(change).all(axis=1)[:, None], change, 0.0).T


def discounted(root: Array, rest: Array, bent: Array) -> tuple[Array, Array]:
    """``root`` (rows, columns) and ``rest`` (rows,) with ``bent`` (rows, directions) as noise beside the unit one."""
    # The inverse root of the whole covariance: whatever the size of what bends, rounding does not make it singular.
    along, sizes, _ = np.linalg.svd(bent, full_matrices=False)
    share = 1.0 - 1.0 / np.hypot(1.0, sizes)
    return root - (along * share) @ (along.T @ root), rest - (along * share) @ (along.T @ rest)
