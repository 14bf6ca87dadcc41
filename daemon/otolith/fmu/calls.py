"""Calls of an FMU's C functions from compiled kernels: no Python runs between two of them.

A table of 64-bit integers has what a call needs: addresses of functions, of the instance and of buffers, and counts.
Kernels get the address of the table as a number among their parameters, as compiled code on disk may hold no address.
The buffer of arguments has states, inputs and parameters, in the FMU's own units; that of rows has rates and outputs.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

MAX_UPDATES = 20
"""Engineering choice: of the discrete states at one point; more is a loop of the FMU."""
REFUSED, FAILED = 2, 3  # fmi2Discard and fmi2Error, as of fmi3: cannot compute this; cannot compute any more
STEP = 1e-6  # of a central difference, as a share of a value or its typical size: near the cube root of the resolution

# Numbers of the entries of the table. Addresses of buffers end with _AT.
(IS_THIRD, IS_MODEL, INSTANCE, SET_STATES, SET_REALS, GET_RATES, GET_REALS, ENTER_EVENTS, UPDATE, ENTER_CONTINUOUS,
 SLOPE, STATES, INPUTS, PARAMETERS, OUTPUTS, SET_AT, ROW_AT, ARGUMENTS_AT, ROWS_AT, SLOPES_AT, SIZES_AT, COLUMN_AT,
 SEED_AT, EVENT_AT, WANTED_AT, STATUS) = range(26)  # fmt: skip
ENTRIES = 26
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
    """Return the status of the C function at an address, called with integers or addresses."""
    count = len(given)

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        wide = ir.IntType(64)
        values = [builder.extract_value(arguments[1], index) for index in range(count)]
        kind = ir.FunctionType(ir.IntType(32), [wide] * count)
        return builder.sext(builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), values), wide)

    return KINDS.int64(KINDS.int64, KINDS.UniTuple(KINDS.int64, count)), code


call: Any = intrinsic(_call)


@njit(error_model="numpy")
def entry(table: int, number: int) -> int:
    """Return an entry of the table."""
    return load(table + 8 * number)  # type: ignore[no-any-return]


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
    if not entry(table, IS_MODEL):
        # In initialization mode start values may be set again, and what follows from them may be read.
        count = states + settable
        status = call(entry(table, SET_REALS), (instance, references, count, arguments, count))
        if status < REFUSED:
            given = (instance, entry(table, ROW_AT), states + outputs, rows, states + outputs)
            status = call(entry(table, GET_REALS), given)
        return status  # type: ignore[no-any-return]
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
    return status  # type: ignore[no-any-return]


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
    step = STEP * max(abs(value), load_real(entry(table, SIZES_AT) + 8 * column))
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
