"""The physical range of components: no more force than the machine's terms balance, and friction that dissipates."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy
from benchmarks.discovery.motor import Faults, simulate_motor, windows
from benchmarks.discovery.setting import problem, screen

from otolith.discovery import candidates
from otolith.discovery.candidate_forms import PhysicalRange
from otolith.discovery.candidates import best_guesses, find_candidates
from otolith.discovery.linear_response import LinearResponse
from otolith.discovery.screening import ScoredGuess, candidate_library, linearised
from otolith.discovery.search import search
from otolith.estimation.information import Prior, initial_prior
from otolith.machine import find_twin
from otolith.twin.components import COMPONENT_FAMILIES, SourceKind, sites, sources
from otolith.twin.rates import rate_terms
from otolith.twin.symbolic import system_of
from tests.discovery.two_mass import DryFriction, simulate
from tests.discovery.two_mass import problem as two_mass_problem

TWIN = problem().base_model
KNOWN = Prior(np.concatenate([problem().nominal, np.zeros(2)]), np.diag([0.01, 2e-6, 1e-4, 1e-8]) ** 2)
LIBRARY = ("dc_motor", "dc_motor_coulomb", "fan", "hydraulic_actuator", "induction_motor", "pmsm", "pump", "servo_axis",
           "two_mass")  # fmt: skip
Torque = Callable[[float, float, float, float, float, float], float]


def response(kind: str, torque: Torque) -> LinearResponse:
    window = windows(simulate_motor(kind, 6.0, Faults(torque=torque), seed=5))[2]
    return screen(problem(), window, KNOWN).response


def physical_range(of: LinearResponse) -> PhysicalRange:
    return PhysicalRange(of.problem.base_model, of.x, of.window.grid.offsets, of.parameters)


def ranges(of: LinearResponse) -> dict[tuple[str, str, str], tuple[float, float]]:
    possible = physical_range(of)
    return {
        (sites(TWIN)[form.site].name, form.model.name, sources(TWIN)[form.source].name): possible.amplitudes(
            form, form.bounds[0]
        )
        for form in candidate_library(TWIN, of.x)
        if form.site < len(TWIN.sites)
    }


def test_a_hump_that_has_almost_vanished_limits_nothing() -> None:
    """At 26.75 times its width it is 2e-311, by which no friction can be divided."""
    of = response("constant", lambda *_: 0.0)
    (form,) = (
        form
        for form in candidate_library(TWIN, of.x)
        if (form.model.name, sources(TWIN)[form.source].name) == ("Stribeck", "omega")
        and sites(TWIN)[form.site].name == "shaft"
    )
    low, high = physical_range(of).amplitudes(form, float(np.abs(of.x[form.source]).max()) / 26.75)
    assert -1.0 < low < high < 1.0


def test_no_amplitude_exceeds_what_the_terms_of_the_equation_balance() -> None:
    """The motor turns with 0.03 N·m against damping and 0.1 N·m of load; its voltage is a few volts."""
    bounds = ranges(response("constant", lambda *_: 0.0))
    assert max(high for (site, family, _), (_, high) in bounds.items() if (site, family) == ("shaft", "constant")) < 0.5
    for (site, family, _), (low, high) in bounds.items():
        if family in ("Stribeck", "Coulomb"):  # the amplitude is the force at rest, which the window need not show
            assert -1.0 < low < high < 1.0 if site == "shaft" else -100.0 < low < high < 100.0


@pytest.mark.parametrize("kind", ["reversing", "steps", "sweep"])
def test_friction_that_drives_is_no_candidate(kind: str) -> None:
    of = response(kind, lambda *moment: 0.004 * float(np.sign(moment[-1])))
    own = [candidate.component for candidate in find_candidates(of) if candidate.component.source == "omega"]
    friction = [component for component in own if component.site == "shaft" and component.model.dissipates]
    assert all(component.amplitude < 0.001 for component in friction)  # the rest of the twin's own damping
    for fitted in search(screen(problem(), of.window, KNOWN)):
        for slot, component in enumerate(fitted.problem.components):
            if (component.site, component.family, component.source) == ("shaft", "Coulomb", "omega"):
                names = [parameter.name for parameter in fitted.problem.free]
                assert fitted.fit.parameters[names.index(f"_amplitude_{slot}")] < 0.001


def test_dry_friction_is_fitted_although_simpler_forms_of_a_lower_score_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own score is too low among forms with an inner parameter, but the linear response underrates it."""
    of = response("reversing", lambda *moment: -0.004 * float(np.sign(moment[-1])))

    def scored(*arguments: Any) -> list[ScoredGuess]:
        simple: list[ScoredGuess] = []
        friction: list[ScoredGuess] = []
        for guess in best_guesses(*arguments):
            model, at_shaft = guess.form.model, sites(TWIN)[guess.form.site].name == "shaft"
            if model.inner is None:
                simple.append(replace(guess, score=30.0 if simple else 100.0))
            elif (model.name, at_shaft, sources(TWIN)[guess.form.source].name) == ("Coulomb", True, "omega"):
                friction.append(replace(guess, score=40.0))
        return [simple[0], *friction, *simple[1:]]

    monkeypatch.setattr(candidates, "best_guesses", scored)
    keys = [candidate.component.key for candidate in find_candidates(of)]
    assert [key for key in keys if "Coulomb" in key], keys
    assert len(keys) == len(set(keys))


def test_friction_may_fall_to_nothing_and_no_further() -> None:
    """A damping that the machine file states too large leaves a negative component, until none of it is left."""
    bounds = ranges(response("reversing", lambda *_: 0.0))
    assert bounds["shaft", "linear", "omega"][1] == pytest.approx(TWIN.parameter("D").nominal, rel=0.05)
    assert bounds["shaft", "linear", "omega"][0] < -0.01
    assert bounds["shaft", "Coulomb", "omega"][1] < 0.001
    coupled = two_mass_problem("D_l")
    known = initial_prior(coupled)
    fitted = linearised(coupled, simulate(2.0, DryFriction())[0], known, known.mean)
    of = LinearResponse(fitted)
    possible, twin = physical_range(of), coupled.base_model
    for form in candidate_library(twin, of.x):
        if (form.site, form.model.name, sources(twin)[form.source].name) == (1, "Coulomb", "omega_l"):
            assert possible.amplitudes(form, form.bounds[0])[1] < 0.01  # not d_s, which no common speed feels


def test_no_exponential_of_a_speed() -> None:
    for row in COMPONENT_FAMILIES:
        assert (SourceKind.SPEED in row.inputs) == (
            row.name not in ("constant", "exponential", "negative exponential", "periodic")
        )
    kinds = {source.name: source.kind for source in sources(TWIN)}
    assert (kinds["omega"], kinds["i"], kinds["V_a"]) == (SourceKind.SPEED, SourceKind.SIGNAL, SourceKind.SIGNAL)


@pytest.mark.parametrize("name", LIBRARY)
def test_terms_of_a_rate_add_up_to_the_rate_of_the_twin(name: str) -> None:
    twin = find_twin(name)
    state = np.array([0.3 * min(each.high, 2.0) for each in twin.states])
    columns = {each.name: np.array([value]) for each, value in zip(twin.states, state, strict=True)}
    columns |= {driven.name: np.array([0.7 * driven.high]) for driven in twin.inputs}
    columns |= {parameter.name: np.array([parameter.nominal]) for parameter in twin.parameters}
    rates = [float(rows.sum()) for rows in rate_terms(twin, columns)]
    system = system_of(twin)
    symbols = (*system.states, *system.inputs, *system.parameters)
    exact = sympy.lambdify(symbols, system.rates, modules=[{"absolute": np.abs, "sign": np.sign}, "numpy"])
    assert rates == pytest.approx(exact(*(columns[symbol.name[2:]][0] for symbol in symbols)), rel=1e-9)
    for site in range(len(twin.sites)):
        more = [float(rows.sum()) for rows in rate_terms(twin, columns, site, 0.1)]
        assert any(abs(a - b) > 1e-12 for a, b in zip(more, rates, strict=True))
