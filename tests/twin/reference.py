"""An independent reference: the expressions of a twin file evaluated by Python and integrated by SciPy.

It uses neither the generator nor SymPy nor numba, so it shares none of their errors.
"""

import math
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from otolith.acquisition.window import Array
from otolith.twin.definition import Definition
from otolith_drivers.units import to_base

MATH = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "log", "sqrt")
FUNCTIONS = {name: getattr(math, name) for name in MATH}
FUNCTIONS |= {
    "abs": abs, "min": min, "max": max, "pi": math.pi, "sign": lambda x: (x > 0) - (x < 0),
    "where": lambda test, then, other: then if test else other,
}  # fmt: skip


class Reference:
    """One twin with given parameters."""

    def __init__(self, definition: Definition, parameters: Array) -> None:
        self._definition = definition
        self._scale = {name: to_base(unit)[0] for name, unit in definition.units().items()}
        self._known = {c.name: c.value * self._scale[c.name] for c in definition.constants}
        names = [parameter.name for parameter in definition.parameters]
        self._known |= {n: float(v) * self._scale[n] for n, v in zip(names, parameters, strict=True)}
        self._states = [state.name for state in definition.states]
        self._inputs = [driven.name for driven in definition.inputs]
        texts = [text for _, text, _ in definition.definitions] + list(dict(definition.equations).values())
        self._compiled = {text: compile(text.replace("^", "**"), "page", "eval") for text in texts}

    def _values(self, state: Array, driven: Array) -> dict[str, float]:
        values = dict(self._known)
        values |= {n: float(v) * self._scale[n] for n, v in zip(self._states, state, strict=True)}
        values |= {n: float(v) * self._scale[n] for n, v in zip(self._inputs, driven, strict=True)}
        pending = [(name, text) for name, text, _ in self._definition.definitions]
        while pending:
            name, text = pending.pop(0)
            try:
                values[name] = self._evaluate(text, values)
            except NameError:
                pending.append((name, text))
        return values

    def _evaluate(self, text: str, values: dict[str, float]) -> float:
        return float(eval(self._compiled[text], {"__builtins__": {}}, FUNCTIONS | values))  # noqa: S307 - our library

    def rates(self, state: Array, driven: Array) -> Array:
        values, right = self._values(state, driven), dict(self._definition.equations)
        return np.array([self._evaluate(right[f"der({n})"], values) / self._scale[n] for n in self._states])

    def outputs(self, state: Array, driven: Array) -> Array:
        values, right = self._values(state, driven), dict(self._definition.equations)
        return np.array(
            [
                (values[name] if name in self._states else self._evaluate(right[name], values)) / self._scale[name]
                for name in (output.name for output in self._definition.outputs)
            ]
        )

    def simulate(self, initial: Array, inputs: Array, period: float, drifts: dict[str, float] | None = None) -> Array:
        """(records, outputs), each record integrated to a tight tolerance.

        ``drifts`` has parameters that move, in their unit per second, to the given value at the last record.
        """
        state, outputs, nominal = np.asarray(initial, dtype=float), [], dict(self._known)

        def move(time: float) -> None:
            for name, rate in (drifts or {}).items():
                self._known[name] = nominal[name] + rate * self._scale[name] * (time - (len(inputs) - 1) * period)

        for record in range(len(inputs)):
            move(record * period)
            outputs.append(self.outputs(state, inputs[record]))
            if record + 1 < len(inputs):
                drive = self._drive(inputs[record], inputs[record + 1], period)

                def rates(t: float, x: Array, drive: Callable[[float], Array] = drive, k: int = record) -> Array:
                    move(k * period + t)
                    return self.rates(x, drive(t))

                done = solve_ivp(rates, (0.0, period), state, method="DOP853", rtol=1e-12, atol=1e-14)
                state = done.y[:, -1]
        self._known = nominal
        return np.array(outputs)

    def _drive(self, now: Array, then: Array, period: float) -> Callable[[float], Array]:
        held = np.array([driven.hold == "zoh" for driven in self._definition.inputs])
        return lambda t: np.where(held, now, now + (then - now) * t / period)
