"""One linearised window: what a change of its unknowns explains, and what that leaves.

Whitened residuals and their derivatives give r = J z + e. The unknowns z are parameters, trends and the initial state,
with the rows of their prior below those of the window. ``docs/explanation/evidence.md`` has the equations.
"""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array

MIN_EXPLAINED = 1e-10  # relative singular value of a direction that a change of the unknowns explains


@dataclass(frozen=True, slots=True, eq=False)
class Elimination:
    """The unknowns of a linearised window, to be eliminated from residuals and responses."""

    basis: Array  # (residuals, directions) orthonormal: what a change of the unknowns explains
    steps: Array  # (unknowns, directions) the changes that do

    @classmethod
    def of(cls, jacobian: Array, scale: Array | None = None) -> "Elimination":
        """Return the elimination of unknowns with the derivatives ``jacobian`` (residuals, unknowns).

        ``scale`` (unknowns,) divides the columns: a direction that then is smaller than rounding explains nothing. It
        is that of the columns by default.
        """
        size = np.linalg.norm(jacobian, axis=0) if scale is None else scale
        size = np.where(size > 0.0, size, np.inf)
        basis, singular, directions = np.linalg.svd(jacobian / size, full_matrices=False)
        kept = singular > MIN_EXPLAINED * max(singular.max(initial=0.0), 1.0)
        return cls(basis[:, kept], (directions[kept] / singular[kept, None] / size).T)

    def left(self, rows: Array) -> Array:
        """Return what is left of ``rows`` (residuals, ...)."""
        return np.asarray(rows - self.basis @ (self.basis.T @ rows))

    def explaining(self, rows: Array) -> Array:
        """Return the change (unknowns, ...) that explains most of ``rows`` (residuals, ...)."""
        return np.asarray(self.steps @ (self.basis.T @ rows))


def chi_square_left(jacobian: Array, residuals: Array) -> float:
    """Return χ² of what the elimination leaves of ``residuals``: a triangular factor is faster than the basis.

    If columns depend on each other, the factor would also leave out a direction that rounding chooses.
    """
    size = np.linalg.norm(jacobian, axis=0)
    alive = size > 0.0
    columns = np.column_stack([jacobian[:, alive] / size[alive], residuals])
    diagonal = np.diag(np.linalg.qr(columns, mode="r"))
    if len(diagonal) == columns.shape[1] and (np.abs(diagonal[:-1]) > MIN_EXPLAINED).all():
        return float(diagonal[-1] ** 2)
    return float((Elimination.of(jacobian).left(residuals) ** 2).sum())
