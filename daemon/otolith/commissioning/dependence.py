"""What an error of a held value would do to the values that were fitted beside it.

A parameter that the data do not determine is held at a value of the twin's example or of the machine file. The others
then explain what an error of it leaves, as far as they act alike: to first order by the least squares response

    dp/dh = −(Aᵀ A)⁻¹ Aᵀ b

with the derivatives of the whitened residuals by the values, ``A``, and by the held one, ``b``. Neither has what
initial states and unknown loads of the windows explain.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.commissioning.shared_fit import SharedFit, projected
from otolith.twin.definition import Parameter

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
TOLERANCE = 0.1  # of a value that a machine file states: by how much it may be wrong
MATERIAL = 0.1  # share of a value per share of a held one, above which the dependence is stated


@dataclass(frozen=True, slots=True)
class Dependence:
    """A held parameter with which a value is right or wrong."""

    name: str
    value: float  # At which it is held, in the unit of the twin
    share: float  # Relative change of the dependent value by a relative change of this one


def is_count(parameter: Parameter, value: float) -> bool:
    """Whether a value is a number of things, as that of pole pairs: one that a file states has no tolerance."""
    return parameter.unit == "1" and value >= 1.0 and float(value).is_integer()


def responses(together: SharedFit, guess: Array, held: Sequence[str], names: Sequence[str]) -> dict[str, Array]:
    """Return by how much each of the ``held`` parameters moves the values ``names``, per unit: (names,) each.

    ``together`` has both as shared parameters, first the names and then those that are held.
    """
    count, free = len(together.scales), len(names)
    slopes = np.array([scale.slope(float(number)) for scale, number in zip(together.scales, guess, strict=False)])
    _, jacobian = together.linearise(guess)
    own = jacobian[:, count:]
    lengths = np.maximum(np.linalg.norm(own, axis=0), np.finfo(float).tiny)
    left = projected(own / lengths, jacobian[:, :count] / slopes)
    sizes = np.maximum(np.linalg.norm(left[:, :free], axis=0), np.finfo(float).tiny)
    moved = -np.linalg.lstsq(left[:, :free] / sizes, left[:, free:], rcond=1e-9)[0] / sizes[:, None]
    return {name: moved[:, at] for at, name in enumerate(held)}


def dependences(
    size: float, half: float, moved: Mapping[str, float], held: Mapping[str, float], stated: frozenset[str]
) -> tuple[tuple[Dependence, ...], float]:
    """Return on which of the ``held`` parameters a value depends, and by how much the others widen its interval.

    ``size`` is that of the value, ``half`` half of its 95 % interval, ``moved`` its change by a unit of each held one.
    An example is of another machine, so its value may be wrong by all of it: a slight effect is added to the interval.
    One that is ``stated`` is trusted unless a usual tolerance would move the value out of its interval.
    """
    found, wider = list[Dependence](), 0.0
    for name, value in held.items():
        share = moved[name] * value / size if size else 0.0
        if abs(share) > MATERIAL and (name not in stated or TOLERANCE * abs(share) * size > half):
            found.append(Dependence(name, value, share))
        elif name not in stated:
            wider += abs(share) * size
    return tuple(sorted(found, key=lambda item: -abs(item.share))), wider
