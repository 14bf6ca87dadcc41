"""The first use of an FMU on a computer: in a process of its own, with a time-out.

What an FMU does when it is loaded, nobody knows before: it may crash, hang, or compute other rates each time. So no
process loads one before a child has tried it; that it passed is kept in the cache, by the digest of the archive.
"""

import contextlib
import hashlib
import json
import math
import os
import pickle
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from otolith.fmu.archive import no_room, store_of
from otolith.fmu.reference import FmuReference
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.outside_text import visible

# Decisions; docs/reference/thresholds-twin.md gives the origin of each and the test that guards it.
TIMEOUT = 60.0  # s of the trial, with the start of the process
MOVED = 0.1  # of the typical size of each argument: how far the second point is from the start values
LATER = 7.3  # s: another time, at which rates must be the same
REPEATED = 1e-9  # relative difference up to which two results are the same
SLOPE_ERROR = 1e-3  # of the largest slope of a row: a directional derivative may differ so much from a difference
STEPS = 50  # after which an FMU is started anew, and goes on as long, to be compared with one that was not
STEP_ERROR = 1e-3  # of the change in all of these steps: how much they may differ
HALF_ERROR = 0.1  # of the largest change in a step: two halves of it may differ so much from it
EVALUATIONS = 200  # that are timed
MAX_ANSWER = 1_000_000  # bytes of the result; each state may be the rate of another one
CHECKED = 0.01  # s: how often it is asked whether the process has ended
MODULE = "otolith.fmu.trial"


class FmuTrial(NamedTuple):
    """What a trial found."""

    seconds: float  # Of one evaluation
    integrals: tuple[tuple[int, int], ...]  # Rates that were states at each point, by the numbers of both


def try_fmu(reference: FmuReference) -> FmuTrial:
    """Return what a child process found of an FMU; it is tried if that was not done on this computer before.

    Raises:
        ConfigurationError: the FMU cannot be used, or the cache; with the reason.
    """
    identity = hashlib.sha256(repr((reference, _dated())).encode()).hexdigest()[:16]
    store = store_of(reference)
    passed = store / f"{reference.digest}.{identity}.tried"
    try:
        return _read(passed.read_bytes(), reference)
    except (OSError, ValueError):
        answer = _answer(reference)
    try:
        passed.write_bytes(answer)
    except OSError as error:
        raise ConfigurationError(no_room(reference, store, error)) from error
    return _read(answer, reference)


def _read(line: bytes, reference: FmuReference) -> FmuTrial:
    """Return what a line says; raise ValueError if it is no result for this FMU."""
    numbers = range(len(reference.states))
    match _loaded(line):
        case {"seconds": float(seconds), "integrals": list(pairs)} if 0.0 <= seconds < math.inf:
            found = tuple(_pair(pair) for pair in pairs)
            if all(number in numbers for pair in found for number in pair):
                return FmuTrial(seconds, found)
    raise ValueError("no result")


def _pair(pair: object) -> tuple[int, int]:
    match pair:
        case [int(rate), int(state)] if bool not in (type(rate), type(state)):
            return rate, state
    raise ValueError("no pair of numbers")


def _loaded(line: bytes) -> object:
    try:
        return json.loads(line)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def _dated() -> str:
    """Return what a new version of the interpreter or of the libraries changes."""
    return f"{sys.version} {np.__version__}"


def _answer(reference: FmuReference) -> bytes:
    """Return the line that a new process writes; raise ConfigurationError if it is no result."""
    try:
        line, status = _child(pickle.dumps(reference))
    except TimeoutError as error:
        fault = f"the FMU did not answer within {TIMEOUT:g} s, so the process that tried it was ended"
        raise ConfigurationError(f"{reference.path}: {fault}: it must be mended") from error
    except OSError as error:
        raise ConfigurationError(f"{reference.path}: cannot be tried: {error.strerror or error}") from error
    try:
        match _loaded(line):
            case {"fault": str(fault)}:
                raise ConfigurationError(f"{reference.path}: {visible(fault, 500)}")
        _read(line, reference)
    except ValueError as error:
        text = f"the FMU ended the process that tried it ({_ending(status)})"
        if line:
            text = "the process that tried the FMU wrote no result, but something else"
        raise ConfigurationError(f"{reference.path}: {text}: it must be mended") from error
    return line


def _ending(status: int) -> str:
    """Return how a process ended, by its exit code, which is negative after a signal."""
    if status >= 0:
        return f"exit code {status}"
    try:
        return signal.Signals(-status).name
    except ValueError:  # those for real time have no names
        return f"signal {-status}"


def _child(given: bytes) -> tuple[bytes, int]:
    """Return the line that the process of a trial writes, and its exit code; what it has started is ended with it.

    Raises:
        TimeoutError: it neither wrote a line nor ended in time.
        OSError: it cannot be started.
    """
    deadline = time.monotonic() + TIMEOUT
    with tempfile.TemporaryFile() as file:  # a pipe would wait for a process that does not read it
        file.write(given)
        file.seek(0)
        process = subprocess.Popen(  # noqa: S603 - ours
            [sys.executable, "-m", MODULE],
            stdin=file,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # without a bound
            start_new_session=True,
        )
    with process:
        try:
            line = _line(process, deadline)
        finally:
            with contextlib.suppress(ProcessLookupError):  # whose number is not given to another one before it is read
                os.killpg(process.pid, signal.SIGKILL)
    return line, process.returncode


def _line(process: subprocess.Popen[bytes], deadline: float) -> bytes:
    """Return the first line that a process writes, at most MAX_ANSWER bytes, or what it wrote until its end.

    Processes that it has started may keep the pipe open after its end.
    """
    found, is_open = b"", True
    with selectors.DefaultSelector() as ready:
        pipe = ready.register(process.stdout, selectors.EVENT_READ).fd  # type: ignore[arg-type]
        while b"\n" not in found and len(found) < MAX_ANSWER:
            has_ended = _has_ended(process)  # before what it wrote last is looked for
            if is_open and ready.select(0.0 if has_ended else CHECKED):
                chunk = os.read(pipe, 1 << 16)
                found, is_open = found + chunk, bool(chunk)
            elif has_ended:
                break
            elif not is_open:
                time.sleep(CHECKED)
            if time.monotonic() > deadline:
                raise TimeoutError
    return found[:MAX_ANSWER].partition(b"\n")[0]


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    """Whether a process has ended, whose number stays its own."""
    try:
        return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None
    except ChildProcessError:  # this process ignores ends of others
        return True


def main() -> None:
    """Try the FMU whose reference is on the standard input; write the result as one line of JSON."""
    answers = os.dup(1)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)  # what it prints is text from outside
    reference = pickle.loads(sys.stdin.buffer.read())  # noqa: S301 - written by the process that started this one
    try:
        answer = _trial(reference)
    except Exception as error:  # noqa: BLE001 - the reason is returned as text
        answer = {"fault": str(error).removeprefix(f"{reference.path}: ") or type(error).__name__}
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
    if reference.is_stepped:
        later, tolerance = FmuInstance(reference, LATER).rows(start[None])[0], STEP_ERROR
    else:
        instance.set_time(LATER)
        later, tolerance = instance.rows(start[None])[0], REPEATED
        instance.set_time(0.0)
    _compare(reference, first, later, "depends on the time, which no twin may but by inputs", tolerance)
    if reference.is_stepped:
        _check_steps(instance, moved)
    if reference.has_slopes:
        _check_slopes(instance, moved if np.isfinite(second).all() else start)
    states = np.array([point[: len(reference.states)] for point in (start, moved)])
    equal = np.isclose(np.array([first, second])[:, :, None], states[:, None, :], rtol=REPEATED, atol=0.0)
    for rate, state in reference.integrals:
        if not equal[:, rate, state].all():
            fault = f"{reference.rates[rate].name!r} of the FMU is not {reference.states[state].name!r}"
            raise ValueError(f"{fault}: leave its derivative out of [twin.variables]")
    found = np.argwhere(equal[:, : len(states[0])].all(axis=0) & (states[1] != 0.0)).tolist()
    found = [] if reference.is_stepped else found  # its rates are mean ones over a step
    begun = time.perf_counter()
    instance.rows(np.repeat(moved[None], EVALUATIONS, axis=0))
    return {"seconds": (time.perf_counter() - begun) / EVALUATIONS, "integrals": found}


def _compare(
    reference: FmuReference,
    one: NDArray[np.float64],
    other: NDArray[np.float64],
    fault: str,
    tolerance: float = REPEATED,
) -> None:
    same = np.isclose(one, other, rtol=tolerance, atol=0.0, equal_nan=True)
    if not same.all():
        raise ValueError(f"{reference.rows[int(np.argmin(same))].name!r} of the FMU: {fault}")


def _check_steps(instance: Any, point: NDArray[np.float64]) -> None:
    """Raise ValueError if the states at the end of a step do not determine what follows, or if nothing moves."""
    reference, states = instance.reference, len(instance.reference.states)
    first = instance.rows(point[None])[0]
    names = ", ".join(row.name for row in reference.rates)
    if not first[:states].any():
        raise ValueError(f"nothing moves in a step of {reference.step:g} s: write step in [twin], or other states")
    lasting = STEPS * reference.step
    halfway = _after(point, instance.rows(point[None], in_a_row=STEPS)[0], lasting, states)
    together = _after(halfway, instance.rows(halfway[None], in_a_row=STEPS)[0], lasting, states)
    going_on = _after(point, instance.rows(point[None], in_a_row=2 * STEPS)[0], 2.0 * lasting, states)
    moved = np.abs(going_on - point)[:states]
    sizes = np.array([row.scale * row.size for row in reference.states])
    wrong = np.abs(going_on - together)[:states] > STEP_ERROR * np.maximum(moved, MOVED * STEP_ERROR * sizes)
    if wrong.any():
        name = reference.rates[int(np.argmax(wrong))].name
        raise ValueError(
            f"{name!r} of the FMU does not follow from the start values of {names}: it has other states, or these"
            " cannot be set: name each in [twin.variables] with state = true"
        )
    following = _after(point, first, reference.step, states)
    shown, late = instance.rows(following[None])[0, states:], instance.rows(point[None], is_late=True)[0, states:]
    for row, one, other in zip(reference.outputs, shown, late, strict=True):
        if not abs(one - other) <= STEP_ERROR * max(abs(other), MOVED * row.scale * row.size):
            values = f"{row.name!r} of the FMU is {one:g} before a step from where it is {other:g} after one"
            raise ValueError(f"{values}: it comes a step late, or is a state: then name it with state = true")
    if not reference.own_step:
        half = _after(point, instance.rows(point[None], 0.5 * reference.step)[0], 0.5 * reference.step, states)
        both = _after(half, instance.rows(half[None], 0.5 * reference.step)[0], 0.5 * reference.step, states)
        moved = np.abs(following - point)[:states]
        if (np.abs(both - following)[:states] > HALF_ERROR * np.maximum(moved, MOVED * STEP_ERROR * sizes)).any():
            raise ValueError(f"two steps of {0.5 * reference.step:g} s do not lead where one of {reference.step:g} s"
                             " does: it has a step of its own: write it as step in [twin]")  # fmt: skip


def _after(point: NDArray[np.float64], rates: NDArray[np.float64], length: float, states: int) -> NDArray[np.float64]:
    """Return a point after a step of a length (s), by its mean rates."""
    following = point.copy()
    following[:states] += length * rates[:states]
    return following


def _check_slopes(instance: Any, point: NDArray[np.float64]) -> None:
    """Raise ValueError if the directional derivatives of an FMU are not those of its rates."""
    offered, differences = instance.slopes(point), instance.slopes(point, by_differences=True)
    can_compare = np.isfinite(differences)
    sizes = np.abs(np.where(can_compare, differences, 0.0)).max(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        is_right = np.abs(offered - differences) <= SLOPE_ERROR * sizes  # not so of NaN
    wrong = can_compare & ~is_right
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        names = instance.reference.rows[row].name, instance.reference.arguments[column].name
        raise ValueError(
            f"its directional derivative of {names[0]!r} by {names[1]!r} is {offered[row, column]:g}, but a difference"
            f" gives {differences[row, column]:g}: it must be mended, or exported without directional derivatives"
        )


if __name__ == "__main__":
    main()
