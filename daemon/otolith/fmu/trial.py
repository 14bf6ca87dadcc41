"""The first use of an FMU on a computer: in a process of its own, with a time-out.

What an FMU does when it is loaded, nobody knows before: it may crash, hang, or compute other rates each time. So no
process loads one before a child has tried it; that it passed is kept in the cache, by the digest of the archive.
"""

import hashlib
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from otolith.fmu.reference import FmuReference
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.outside_text import visible
from otolith_drivers.user_dirs import cache_directory

# Decisions; docs/reference/thresholds-twin.md gives the origin of each and the test that guards it.
TIMEOUT = 60.0  # s of the trial, with the start of the process
MOVED = 0.1  # of the typical size of each argument: how far the second point is from the start values
LATER = 7.3  # s: another time, at which rates must be the same
REPEATED = 1e-9  # relative difference up to which two results are the same
SLOPE_ERROR = 1e-3  # of the largest slope of a row: a directional derivative may differ so much from a difference
EVALUATIONS = 200  # that are timed
MODULE = "otolith.fmu.trial"


class FmuTrial(NamedTuple):
    """What a trial found."""

    seconds: float  # Of one evaluation
    integrals: tuple[tuple[int, int], ...]  # Rates that were states at each point, by the numbers of both


def try_fmu(reference: FmuReference) -> FmuTrial:
    """Return what a child process found of an FMU; it is tried if that was not done on this computer before.

    Raises:
        ConfigurationError: the FMU cannot be used; with the reason.
        ServiceError: the cache cannot be used.
    """
    identity = hashlib.sha256(repr((reference, _dated())).encode()).hexdigest()[:16]
    passed = cache_directory("fmus") / f"{reference.digest}.{identity}.tried"
    try:
        return _read(passed.read_bytes())
    except (OSError, ValueError, KeyError, TypeError):
        answer = _answer(reference)
    passed.write_bytes(answer)
    return _read(answer)


def _read(answer: bytes) -> FmuTrial:
    content = json.loads(answer)
    return FmuTrial(float(content["seconds"]), tuple((int(rate), int(state)) for rate, state in content["integrals"]))


def _dated() -> str:
    """Return what a new version of the interpreter or of the libraries changes."""
    return f"{sys.version} {np.__version__}"


def _answer(reference: FmuReference) -> bytes:
    command = [sys.executable, "-m", MODULE]
    given = pickle.dumps(reference)
    try:
        done = subprocess.run(command, input=given, capture_output=True, timeout=TIMEOUT, check=False)  # noqa: S603 - ours
    except subprocess.TimeoutExpired as error:
        fault = f"the FMU did not answer within {TIMEOUT:g} s, so the process that tried it was ended"
        raise ConfigurationError(f"{reference.path}: {fault}") from error
    except OSError as error:
        raise ConfigurationError(f"{reference.path}: cannot be tried: {error.strerror}") from error
    try:
        line = done.stdout.splitlines()[-1]
        answer = json.loads(line)
    except (IndexError, ValueError) as error:
        how = f"exit code {done.returncode}"
        if done.returncode < 0:
            how = signal.Signals(-done.returncode).name
        text = f"the FMU ended the process that tried it ({how}): it must be mended"
        raise ConfigurationError(f"{reference.path}: {text}") from error
    if fault := answer.get("fault"):
        raise ConfigurationError(f"{reference.path}: {visible(str(fault), 500)}")
    return line


def main() -> None:
    """Try the FMU whose reference is on the standard input; write the result as one line of JSON."""
    answers = os.dup(1)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)  # what it prints is text from outside
    reference = pickle.loads(sys.stdin.buffer.read())  # noqa: S301 - written by the process that started this one
    try:
        answer = _trial(reference)
    except Exception as error:  # noqa: BLE001 - the reason is returned as text
        answer = {"fault": str(error).removeprefix(f"{reference.path}: ")}
    os.write(answers, f"{json.dumps(answer)}\n".encode())
    os._exit(0)  # what an FMU does at the end of its process cannot hold this up


def _trial(reference: FmuReference) -> dict[str, object]:
    """Return the content of :class:`FmuTrial`; raise ValueError if a twin cannot be made of the FMU."""
    from otolith.fmu.instance import FmuInstance  # noqa: PLC0415 - loads Numba, which only the child needs

    instance = FmuInstance(reference)
    scales = np.array([item.scale for item in reference.arguments])
    start = scales * np.array([item.start for item in reference.arguments])
    moved = start + MOVED * scales * np.array([item.size for item in reference.arguments])
    first, second, again = (instance.rows(point[None])[0] for point in (start, moved, start))
    if not (np.isfinite(first).all() or np.isfinite(second).all()):
        raise ValueError("the FMU computes no rates, neither from its start values nor near them")
    _compare(reference, first, again, "what it computes depends on what it computed before, so it has no rates")
    instance.set_time(LATER)
    _compare(reference, first, instance.rows(start[None])[0], "depends on the time, which no twin may but by inputs")
    instance.set_time(0.0)
    if reference.has_slopes:
        _check_slopes(instance, moved[None])
    states = np.array([point[: len(reference.states)] for point in (start, moved)])
    equal = np.isclose(np.array([first, second])[:, :, None], states[:, None, :], rtol=REPEATED, atol=0.0)
    for rate, state in reference.integrals:
        if not equal[:, rate, state].all():
            fault = f"{reference.rates[rate].name!r} of the FMU is not {reference.states[state].name!r}"
            raise ValueError(f"{fault}: leave its derivative out of [twin.variables]")
    found = np.argwhere(equal[:, : len(states[0])].all(axis=0) & (states[1] != 0.0)).tolist()
    begun = time.perf_counter()
    instance.rows(np.repeat(moved[None], EVALUATIONS, axis=0))
    return {"seconds": (time.perf_counter() - begun) / EVALUATIONS, "integrals": found}


def _compare(reference: FmuReference, one: NDArray[np.float64], other: NDArray[np.float64], fault: str) -> None:
    same = np.isclose(one, other, rtol=REPEATED, atol=0.0, equal_nan=True)
    if not same.all():
        raise ValueError(f"{reference.rows[int(np.argmin(same))].name!r} of the FMU: {fault}")


def _check_slopes(instance: Any, point: NDArray[np.float64]) -> None:
    """Raise ValueError if the directional derivatives of an FMU are not those of its rates."""
    offered, differences = instance.slopes(point[0]), instance.slopes(point[0], by_differences=True)
    sizes = np.abs(differences).max(axis=1, keepdims=True)
    wrong = np.abs(offered - differences) > SLOPE_ERROR * sizes
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        names = instance.reference.rows[row].name, instance.reference.arguments[column].name
        raise ValueError(
            f"its directional derivative of {names[0]!r} by {names[1]!r} is {offered[row, column]:g}, but a difference"
            f" gives {differences[row, column]:g}: it must be mended, or exported without directional derivatives"
        )


if __name__ == "__main__":
    main()
