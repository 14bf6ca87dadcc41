"""Calls of an FMU's C functions from compiled kernels: no Python runs between two of them.

A table of 64-bit integers has what a call needs: addresses of functions, of the instance and of buffers, and counts.
Kernels get the address of the table as a number among their parameters, as compiled code on disk may hold no address.
The buffer of arguments has states, inputs and parameters, in the FMU's own units; that of rows has rates and outputs.

An FMU whose derivatives cannot be read is stepped: its rates are the mean ones over a step from the arguments on.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from otolith.fmu.reference import OF_STEPPED

MAX_UPDATES = 20
"""Engineering choice: of the discrete states at one point; more is a loop of the FMU."""
REFUSED, FAILED = 2, 3  # fmi2Discard and fmi2Error, as of fmi3: cannot compute this; cannot compute any more
STEP = 1e-6  # of a central difference, as a share of a value or its typical size: near the cube root of the resolution
WHOLE = 1e-6
"""Engineering choice: of a step of an FMU's own, a share that rounding leaves over a whole number."""

# Numbers of the entries of the table. Addresses of buffers end with _AT.
(IS_THIRD, IS_MODEL, INSTANCE, SET_STATES, SET_REALS, GET_RATES, GET_REALS, ENTER_EVENTS, UPDATE, ENTER_CONTINUOUS,
 SLOPE, STATES, INPUTS, PARAMETERS, OUTPUTS, SET_AT, ROW_AT, ARGUMENTS_AT, ROWS_AT, SLOPES_AT, SIZES_AT, COLUMN_AT,
 SEED_AT, EVENT_AT, WANTED_AT, STATUS, IS_STEPPED, SAVED, RESTORE, RESET, SET_UP, INITIALISE, BEGIN, DO_STEP, END_AT,
 HIDES_RATES, IN_A_ROW, IS_LATE) = range(38)  # fmt: skip
REALS = 38  # Entries from here on are numbers of double precision.
START, LENGTH, OWN_STEP = range(REALS, REALS + 3)
"""Time at which a step begins, length of a step, and length of the FMU's own steps (0 if it makes steps of any), s."""
ENTRIES = REALS + 3
OF_STATES, OF_INPUTS, OF_PARAMETERS = 1, 2, 4
EVENT_BYTES = 48
NEXT_TIME = 24  # bytes in the buffer of events to the time of the next one, in FMI 3


KINDS: Any = types  # Numba's types are made at run time


def _loader(kind: Any, width: ir.Type) -> Any:
    def load(context: Any, address: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            value = builder.load(builder.inttoptr(arguments[0], width.as_pointer()))
            return value if kind is KINDS.float64 else builder.sext(value, ir.IntType(64))

        return kind(KINDS.int64), code

    return intrinsic(load)


load = _loader(KINDS.int64, ir.IntType(64))
load_real = _loader(KINDS.float64, ir.DoubleType())
load_int = _loader(KINDS.int64, ir.IntType(32))
load_byte = _loader(KINDS.int64, ir.IntType(8))


def _storer(kind: Any, width: ir.Type) -> Any:
    def store(context: Any, address: Any, value: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            builder.store(arguments[1], builder.inttoptr(arguments[0], width.as_pointer()))
            return context.get_dummy_value()

        return KINDS.void(KINDS.int64, kind), code

    return intrinsic(store)


store = _storer(KINDS.int64, ir.IntType(64))
store_real = _storer(KINDS.float64, ir.DoubleType())


def _call(context: Any, function: Any, given: Any) -> Any:
    """Return the status of the C function at an address, called with integers, addresses or real numbers."""
    are_real = [kind is KINDS.float64 for kind in given]

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        wide = ir.IntType(64)
        values = [builder.extract_value(arguments[1], index) for index in range(len(are_real))]
        kind = ir.FunctionType(ir.IntType(32), [ir.DoubleType() if is_real else wide for is_real in are_real])
        return builder.sext(builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), values), wide)

    of_each = [KINDS.float64 if is_real else KINDS.int64 for is_real in are_real]
    return KINDS.int64(KINDS.int64, KINDS.Tuple(of_each)), code


call: Any = intrinsic(_call)


@njit(error_model="numpy")
def entry(table: int, number: int) -> int:
    """Return an entry of the table."""
    return load(table + 8 * number)  # type: ignore[no-any-return]  # numba has no types


@njit(error_model="numpy")
def update(table: int) -> int:
    """Update the discrete states until they stay; return the worst status, REFUSED if they do not stay."""
    instance, event, function = entry(table, INSTANCE), entry(table, EVENT_AT), entry(table, UPDATE)
    worst: int = 0
    for _ in range(MAX_UPDATES):
        if entry(table, IS_THIRD):
            given = (instance, event, event + 1, event + 2, event + 3, event + 4, event + NEXT_TIME)
            worst = max(worst, call(function, given))
            needed, ends, moved = load_byte(event), load_byte(event + 1), load_byte(event + 3)
        else:
            worst = max(worst, call(function, (instance, event)))
            needed, ends, moved = load_int(event), load_int(event + 4), load_int(event + 12)
        if ends or moved:
            break
        if not needed:
            return worst
    return max(REFUSED, worst)


@njit(error_model="numpy")
def computed(table: int) -> int:
    """Compute the rows for the arguments; return the first status that is no success, or the last one."""
    instance, arguments, rows = entry(table, INSTANCE), entry(table, ARGUMENTS_AT), entry(table, ROWS_AT)
    states, outputs = entry(table, STATES), entry(table, OUTPUTS)
    settable, references = entry(table, INPUTS) + entry(table, PARAMETERS), entry(table, SET_AT)
    if entry(table, IS_STEPPED):
        return stepped(table)
    if not entry(table, IS_MODEL):
        # In initialization mode start values may be set again, and what follows from them may be read.
        count = states + settable
        status = call(entry(table, SET_REALS), (instance, references, count, arguments, count))
        if status < REFUSED:
            given = (instance, entry(table, ROW_AT), states + outputs, rows, states + outputs)
            status = call(entry(table, GET_REALS), given)
        return status  # type: ignore[no-any-return]  # numba has no types
    status = call(entry(table, SET_STATES), (instance, arguments, states))
    # Parameters and discrete inputs may be set at an event only, and what depends on a limit is decided there.
    if status < REFUSED:
        status = call(entry(table, ENTER_EVENTS), (instance,))
    if status < REFUSED and settable:
        given = (instance, references + 4 * states, settable, arguments + 8 * states, settable)
        status = call(entry(table, SET_REALS), given)
    if status < FAILED:  # a value that it discards must not leave it in event mode
        status = max(status, update(table))
    if status < FAILED:
        status = max(status, call(entry(table, ENTER_CONTINUOUS), (instance,)))
    if status < REFUSED:
        status = call(entry(table, GET_RATES), (instance, rows, states))
    if status < REFUSED and outputs:
        given = (instance, entry(table, ROW_AT) + 4 * states, outputs, rows + 8 * states, outputs)
        status = call(entry(table, GET_REALS), given)
    return status  # type: ignore[no-any-return]  # numba has no types


@njit(error_model="numpy")
def real_entry(table: int, number: int) -> float:
    """Return one of the entries that are numbers of double precision."""
    return load_real(table + 8 * number)  # type: ignore[no-any-return]  # numba has no types


@njit(error_model="numpy")
def set_length(table: int, length: float) -> None:
    """Set the length of the next steps, s."""
    store_real(table + 8 * LENGTH, length)


@njit(error_model="numpy")
def restored(table: int) -> int:
    """Bring the FMU into initialization mode with its start values; return the first status that is no success."""
    instance = entry(table, INSTANCE)
    if entry(table, SAVED):
        return call(entry(table, RESTORE), (instance, entry(table, SAVED)))  # type: ignore[no-any-return]  # numba has no types
    start, tolerance = real_entry(table, START), 0.0
    status = call(entry(table, RESET), (instance,))
    if status < REFUSED and entry(table, IS_THIRD):
        status = call(entry(table, INITIALISE), (instance, 0, tolerance, start, 0, start))
    elif status < REFUSED:
        status = call(entry(table, SET_UP), (instance, 0, tolerance, start, 0, start))
        if status < REFUSED:
            status = call(entry(table, INITIALISE), (instance,))
    return status  # type: ignore[no-any-return]  # numba has no types


@njit(error_model="numpy")
def made_step(table: int, begin: float, length: float) -> int:
    """Let the FMU make one step from ``begin`` on, both in s; return its status, REFUSED if it ends before.

    It is told that it may forget what lies before, unless it is brought back there by its saved state.
    """
    instance, event, function = entry(table, INSTANCE), entry(table, EVENT_AT), entry(table, DO_STEP)
    may_forget = 0 if entry(table, SAVED) else 1
    if not entry(table, IS_THIRD):
        return call(function, (instance, begin, length, may_forget))  # type: ignore[no-any-return]  # numba has no types
    given = (instance, begin, length, may_forget, event, event + 1, event + 2, event + NEXT_TIME)
    status = call(function, given)
    if status < REFUSED and (load_byte(event + 1) or load_byte(event + 2)):
        return REFUSED
    return status  # type: ignore[no-any-return]  # numba has no types


@njit(error_model="numpy")
def read_states(table: int, into: int) -> int:
    """Read the states into a buffer; return the status."""
    states = entry(table, STATES)
    given = (entry(table, INSTANCE), entry(table, ROW_AT), states, into, states)
    return call(entry(table, GET_REALS), given)  # type: ignore[no-any-return]  # numba has no types


@njit(error_model="numpy")
def advanced(table: int, begin: float) -> int:
    """Let time go on by LENGTH and leave the states in the buffer END_AT; return the first status that is no success.

    An FMU with steps of its own makes a whole number of them. Between the ends of the last two the states are taken to
    go along a line.
    """
    length, own, end, before = real_entry(table, LENGTH), real_entry(table, OWN_STEP), entry(table, END_AT), 0
    if own <= 0.0:
        status = made_step(table, begin, length)
        return read_states(table, end) if status < REFUSED else status
    whole = int(length / own + WHOLE)
    rest = length / own - whole
    before = end + 8 * entry(table, STATES)
    status = 0
    if whole:
        status = made_step(table, begin, whole * own)
    if status < REFUSED:
        status = read_states(table, end)
    if status >= REFUSED or rest < WHOLE:
        return status
    for state in range(entry(table, STATES)):
        store_real(before + 8 * state, load_real(end + 8 * state))
    status = made_step(table, begin + whole * own, own)
    if status < REFUSED:
        status = read_states(table, end)
    for state in range(entry(table, STATES)):
        first = load_real(before + 8 * state)
        store_real(end + 8 * state, first + rest * (load_real(end + 8 * state) - first))
    return status


@njit(error_model="numpy")
def stepped(table: int) -> int:
    """Compute the rows for the arguments by a step: mean rates over it, and the outputs at its beginning.

    With IN_A_ROW the step is followed by others like it. With IS_LATE the outputs are those at the end.
    """
    instance, arguments, rows = entry(table, INSTANCE), entry(table, ARGUMENTS_AT), entry(table, ROWS_AT)
    states, outputs, end = entry(table, STATES), entry(table, OUTPUTS), entry(table, END_AT)
    count = states + entry(table, INPUTS) + entry(table, PARAMETERS)
    of_outputs = (instance, entry(table, ROW_AT) + 4 * states, outputs, rows + 8 * states, outputs)
    status = restored(table)
    if status < REFUSED:
        status = call(entry(table, SET_REALS), (instance, entry(table, SET_AT), count, arguments, count))
    if status < REFUSED and outputs:
        status = call(entry(table, GET_REALS), of_outputs)
    if status >= REFUSED or entry(table, HIDES_RATES):
        return status
    status = call(entry(table, BEGIN), (instance,))
    for number in range(entry(table, IN_A_ROW)):
        if status < REFUSED:
            status = advanced(table, real_entry(table, START) + number * real_entry(table, LENGTH))
    if status < REFUSED and outputs and entry(table, IS_LATE):
        status = call(entry(table, GET_REALS), of_outputs)
    length = entry(table, IN_A_ROW) * real_entry(table, LENGTH)
    for state in range(states):
        change = load_real(end + 8 * state) - load_real(arguments + 8 * state)
        store_real(rows + 8 * state, change / length)
    return status


@njit(error_model="numpy")
def evaluate(table: int) -> None:
    """Fill the rows for the arguments; with NaN if the FMU cannot compute them, whose status is kept.

    After an error of its own nothing more is called: a new instance must replace it.
    """
    status = entry(table, STATUS)
    if status < FAILED:
        status = computed(table)
    if status >= REFUSED:
        for row in range(entry(table, STATES) + entry(table, OUTPUTS)):
            store_real(entry(table, ROWS_AT) + 8 * row, np.nan)
        if status > entry(table, STATUS):
            store(table + 8 * STATUS, status)


@njit(error_model="numpy")
def evaluate_outputs(table: int) -> None:
    """As evaluate, but an FMU that is stepped makes no step, so that its rates have no value."""
    store(table + 8 * HIDES_RATES, 1)
    evaluate(table)
    store(table + 8 * HIDES_RATES, 0)


@njit(error_model="numpy")
def differentiate(table: int, groups: int) -> None:
    """Fill the rows, and their slopes by some groups of arguments, of parameters by those that are wanted.

    ``groups`` is a sum of OF_STATES, OF_INPUTS and OF_PARAMETERS. Slopes are directional derivatives where the FMU
    offers them, which it does not by parameters, and central differences elsewhere.
    """
    states, known = entry(table, STATES), entry(table, STATES) + entry(table, INPUTS)
    offered = entry(table, SLOPE) != 0
    for column in range(known if offered else 0, known + entry(table, PARAMETERS)):
        if column >= known:
            needed = groups & OF_PARAMETERS and load_byte(entry(table, WANTED_AT) + column - known)
        else:
            needed = groups & (OF_STATES if column < states else OF_INPUTS)
        if needed:
            by_difference(table, column)
    evaluate(table)
    if offered:
        for column in range(known):
            if groups & (OF_STATES if column < states else OF_INPUTS):
                directional(table, column)


@njit(error_model="numpy")
def slope_at(table: int, row: int, column: int) -> int:
    """Return the address of a slope."""
    width = entry(table, STATES) + entry(table, INPUTS) + entry(table, PARAMETERS)
    return entry(table, SLOPES_AT) + 8 * (row * width + column)


@njit(error_model="numpy")
def by_difference(table: int, column: int) -> None:
    """Fill the slopes by an argument with central differences; the rows change."""
    place, rows = entry(table, ARGUMENTS_AT) + 8 * column, entry(table, ROWS_AT)
    value, height = load_real(place), entry(table, STATES) + entry(table, OUTPUTS)
    share = OF_STEPPED if entry(table, IS_STEPPED) else STEP
    step = share * max(abs(value), load_real(entry(table, SIZES_AT) + 8 * column))
    store_real(place, value + step)
    evaluate(table)
    for row in range(height):
        store_real(slope_at(table, row, column), load_real(rows + 8 * row))
    store_real(place, value - step)
    evaluate(table)
    for row in range(height):
        at = slope_at(table, row, column)
        store_real(at, (load_real(at) - load_real(rows + 8 * row)) / (2.0 * step))
    store_real(place, value)


@njit(error_model="numpy")
def directional(table: int, column: int) -> None:
    """Fill the slopes by a state or an input with the derivatives that the FMU itself offers."""
    instance, result, height = entry(table, INSTANCE), entry(table, COLUMN_AT), entry(table, STATES)
    height += entry(table, OUTPUTS)
    seed, of_rows, by = entry(table, SEED_AT), entry(table, ROW_AT), entry(table, SET_AT) + 4 * column
    status = entry(table, STATUS)
    if status < FAILED and entry(table, IS_THIRD):
        status = call(entry(table, SLOPE), (instance, of_rows, height, by, 1, seed, 1, result, height))
    elif status < FAILED:
        status = call(entry(table, SLOPE), (instance, of_rows, height, by, 1, seed, result))
    for row in range(height):
        value = load_real(result + 8 * row) if status < REFUSED else np.nan
        store_real(slope_at(table, row, column), value)
    if status >= REFUSED and status > entry(table, STATUS):
        store(table + 8 * STATUS, status)


@njit(error_model="numpy")
def sweep(table: int, given: Any, found: Any) -> None:
    """Fill ``found`` (records, rows) for the arguments ``given`` (records, arguments)."""
    for record in range(len(given)):
        for column in range(given.shape[1]):
            store_real(entry(table, ARGUMENTS_AT) + 8 * column, given[record, column])
        evaluate(table)
        for row in range(found.shape[1]):
            found[record, row] = load_real(entry(table, ROWS_AT) + 8 * row)
