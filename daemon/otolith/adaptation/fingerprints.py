"""Fingerprints of what estimates depend on: equal ones mean that what was learned before still holds."""

import hashlib
import json

from otolith.estimation.problem import Problem
from otolith.twin.definition import Definition


def twin_fingerprint(twin: Definition) -> str:
    """Return a hash of what the equations of a twin mean; titles and meanings in words do not count."""
    quantities = (twin.states, twin.parameters, twin.outputs)
    named = [[(each.name, each.unit) for each in group] for group in quantities]
    inputs = [(each.name, each.unit, each.hold) for each in twin.inputs]
    constants = [(each.name, each.unit, each.value) for each in twin.constants]
    definitions = [(name, expression) for name, expression, _ in twin.definitions]
    places = [(each.name, each.unit, each.into, each.mode, each.through) for each in twin.sites]
    of_fmu = [] if twin.fmu is None else [twin.fmu.digest]
    return _hash([named, inputs, constants, definitions, places, twin.equations, *of_fmu])


def configuration_fingerprint(problem: Problem) -> str:
    """Return a hash of what the machine file states of parameters and noise, without what was learned."""
    free = [(item.name, item.nominal, item.low, item.high) for item in problem.free if not item.name.startswith("_")]
    known = [pair for pair in problem.known if not pair[0].startswith("_")]
    stated = problem.with_levels(problem.stated_levels)
    noise = stated.noise, stated.input_noise, stated.process_noise
    return _hash([free, known, noise, problem.open_loop])


def kernels_fingerprint(problem: Problem) -> str:
    """Return a hash of what the kernels of a first window depend on: twin, free parameters, kinds of noise."""
    free = [item.name for item in problem.free]
    noise = [[level > 0.0 for level in levels] for levels in (problem.input_noise, problem.process_noise)]
    return _hash([twin_fingerprint(problem.twin), free, noise, problem.open_loop, problem.discover])


def values_fingerprint(problem: Problem) -> str:
    """Return a hash of the values of the known parameters, with which a component is found."""
    return _hash([pair for pair in problem.known if not pair[0].startswith("_")])


def model_fingerprint(twin: str, values: str) -> str:
    """Return a hash of the fingerprints of a twin and of its values; empty if one of them is not known."""
    return _hash([twin, values]) if twin and values else ""


def fingerprint_of(problem: Problem) -> str:
    """Return the hash of the twin and the known values with which parameters are estimated, and limits hold."""
    return model_fingerprint(twin_fingerprint(problem.base_model), values_fingerprint(problem))


def _hash(content: list[object]) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]
