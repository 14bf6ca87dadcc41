"""PySINDy on a typical case, with every advantage.

(A. A. Kaptanoglu et al., PySINDy: a comprehensive package, JOSS 7, 2022; U. Fasel et al., Ensemble-SINDy, 2022.)

In its favour: the known part of the motor's equations, with its true parameters, is subtracted from the derivatives, so
that only the component is left to find, and both are smoothed alike; the library has sines of the right frequency, the
right rate of the exponential and the sign of the speed beside all polynomials of degree 2; columns are of unit size,
and derivatives in shares of what drives them; and its smoothing, ridge and threshold are those that do best over the
whole table, which is unknown beforehand.
"""

import importlib
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.discovery.motor import K_E, K_T, L_A, R_A, SIGNALS, D, J
from benchmarks.discovery.truth import SHAFT, SOURCES, Truth
from benchmarks.discovery.typical import PERIOD, Answer, Recorded, Typical, error_of, inputs_of
from otolith.acquisition.window import Array

THRESHOLDS = (0.003, 0.01, 0.02, 0.05, 0.1, 0.2)  # of a coefficient, in shares of what drives the motor
RIDGES = (0.05, 5.0)  # its default, and one for nearly collinear columns
SMOOTHED = (7, 21)  # records
DRIVE = np.array([0.05, 5.0])  # N·m, V: about what the current's torque and the voltage are
FREQUENCIES = (5.0, 10.0, 20.0, 40.0)  # rad/s
ORDERS = (1.0, 2.0, 3.0)  # per turn
RATES = (0.05, 0.15)  # s/rad
STLSQ, ENSEMBLE = "STLSQ", "ensemble"
MODELS = 10


def answers(case: Typical, record: Recorded, seed: int) -> dict[str, Answer]:
    """One answer per variant and setting; the name is the variant, a space, the setting."""
    sindy = importlib.import_module("pysindy")  # optional, and without types
    answers = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about thresholds that remove all terms
        for smoothed in SMOOTHED:
            smooth, targets = unexplained_derivatives(sindy, record.measured, smoothed)
            names, columns = library(sindy, smooth)
            inside = slice(smoothed // 2, -(smoothed // 2))  # the filter is inaccurate at the ends
            theta, target = columns / _size(columns), targets / DRIVE
            for name, optimizer in _optimizers(sindy):
                np.random.seed(seed)  # noqa: NPY002 - the ensemble draws from the global generator
                terms = np.asarray(optimizer.fit(theta[inside], target[inside]).coef_) * DRIVE[:, None]
                answers[f"{name}/{smoothed}"] = _answer(case, record, names, theta, terms)
    return answers


def _optimizers(sindy: Any) -> Iterator[tuple[str, Any]]:
    for threshold in THRESHOLDS:
        for ridge in RIDGES:
            yield f"{STLSQ} {threshold}/{ridge}", sindy.STLSQ(threshold=threshold, alpha=ridge)
        one = sindy.STLSQ(threshold=threshold, alpha=RIDGES[-1])
        yield f"{ENSEMBLE} {threshold}/{RIDGES[-1]}", sindy.EnsembleOptimizer(one, bagging=True, n_models=MODELS)


def _size(columns: Array) -> Array:
    """(columns,) root mean squares."""
    return np.asarray(np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-12))


def unexplained_derivatives(sindy: Any, measured: Array, smoothed: int) -> tuple[Array, Array]:
    """(records, signals) -> smoothed signals, and (records, 2) torque and voltage beyond the known equations.

    The voltage jumps at a record and holds to the next: a centred difference sees the mean of two, so the mean
    is smoothed with the other signals.
    """
    signals = measured.copy()
    signals[1:, 0] = (measured[1:, 0] + measured[:-1, 0]) / 2.0
    difference = sindy.SmoothedFiniteDifference(smoother_kws={"window_length": smoothed, "polyorder": 3})
    slopes = np.asarray(difference._differentiate(signals, PERIOD * np.arange(len(measured), dtype=np.float64)))
    smooth = np.asarray(difference.smoothed_x_)
    held, load, i, omega = smooth.T
    torque = J * slopes[:, SIGNALS.index("omega")] - (K_T * i - load - D * omega)
    voltage = L_A * slopes[:, SIGNALS.index("i")] - (held - R_A * i - K_E * omega)
    return smooth, np.column_stack([torque, voltage])


def library(sindy: Any, smooth: Array) -> tuple[list[str], Array]:
    """Names and (records, columns)."""
    x = inputs_of(smooth)
    polynomials = sindy.PolynomialLibrary(degree=2)
    columns = [np.asarray(polynomials.fit_transform(x))]
    names = list(polynomials.get_feature_names(list(SOURCES)))
    t, angle, omega = x[:, 0], x[:, 1], x[:, SOURCES.index("omega")]
    more = {"sign(omega)": np.sign(omega)}
    for source, values, frequencies in (("t", t, FREQUENCIES), ("angle(omega)", angle, ORDERS)):
        for frequency in frequencies:
            more[f"sin({frequency:g} {source})"] = np.sin(frequency * values)
            more[f"cos({frequency:g} {source})"] = np.cos(frequency * values)
    for rate in RATES:
        more[f"exp({rate:g} omega)"] = np.exp(rate * omega)
    return names + list(more), np.column_stack([*columns, *more.values()])


def true_terms(truth: Truth) -> frozenset[str]:
    """The columns of the truth and of its equivalents in this motor."""
    inner, source = f"{truth.inner:g}", truth.source
    match truth.family:
        case "constant":
            return frozenset({"1"})
        case "periodic":
            return frozenset({f"sin({inner} {source})", f"cos({inner} {source})"})
        case "Coulomb":
            return frozenset({"sign(omega)"})
        case "power":
            return frozenset({"omega^2", "T_load^2", "T_load omega"})
        case "exponential":
            return frozenset({f"exp({inner} omega)"})
    return frozenset({source})


def _answer(case: Typical, record: Recorded, names: list[str], theta: Array, terms: Array) -> Answer:
    """``theta`` (records, columns) of unit size, ``terms`` (2, columns): torque, then voltage."""
    there = terms != 0.0
    if case.truth is None:
        return Answer(not there.any(), np.nan, int(there.sum()))
    equation, terms_true = 0 if case.truth.site == SHAFT else 1, true_terms(case.truth)
    right = np.array([name in terms_true for name in names])
    own = terms[equation]
    spurious = int(there.sum() - there[equation, right].sum())
    largest = int(np.abs(own).argmax())
    if not own.any() or not right[largest]:
        return Answer(False, np.nan, spurious)
    effect = theta[:, right] @ own[right]
    return Answer(True, error_of(effect, record.effect(case.truth)), spurious)
