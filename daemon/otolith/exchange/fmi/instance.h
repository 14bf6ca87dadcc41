/* What an FMU does in both versions of FMI: its memory, its variables and its integrator.

   model.h, which is generated, has the equations, the groups of variables and their start values. Everything is static,
   so that several such FMUs may be linked into one program. */

#ifndef OTOLITH_INSTANCE_H
#define OTOLITH_INSTANCE_H

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

enum { MESSAGE = 160 };         /* characters of a message, at most */
static const double WHOLE = 1e-9; /* of a substep: what rounding leaves over a whole number needs no further one */

/* All that changes: a state of the FMU is a copy of it. */
typedef struct {
    double variables[VARIABLES];  /* each in its unit, by its value reference; the first is the time, s */
    double slopes[INPUTS + 1];    /* of the inputs until the end of the next step, per second */
    double start;                 /* time at which the experiment begins, s */
    long is_current;              /* whether computed variables belong to the others */
} Memory;

/* Sets inputs as they are at the time of the variables; owner is the instance. */
typedef void Drive(void *owner);

static inline void begin(Memory *memory)
{
    memset(memory, 0, sizeof *memory);
    memcpy(memory->variables, START, sizeof memory->variables);
}

static inline const double *current(Memory *memory)
{
    if (!memory->is_current) {
        compute(memory->variables[0] - memory->start, memory->variables);
        memory->is_current = 1;
    }
    return memory->variables;
}

static inline int is_in(size_t reference, int first, int count)
{
    return reference >= (size_t)first && reference < (size_t)(first + count);
}

/* Whether an importer may set a variable: an input, a parameter, or a state that it begins with. */
static inline int may_set(size_t reference)
{
    return is_in(reference, FIRST_INPUT, INPUTS) || is_in(reference, FIRST_PARAMETER, PARAMETERS) ||
           is_in(reference, FIRST_STATE, STATES);
}

static inline void set(Memory *memory, size_t reference, double value)
{
    memory->variables[reference] = value;
    memory->is_current = 0;
}

/* Advance the states by a length (s) with the classical Runge-Kutta method, by equal substeps that are no longer than
   MAX_STEP. Return whether all states are finite. */
static inline int advance(Memory *memory, double length, Drive *drive, void *owner)
{
    static const double shares[4] = {0.0, 0.5, 0.5, 1.0}, weights[4] = {1.0, 2.0, 2.0, 1.0};
    const double start = memory->variables[0];
    const double parts = fmax(ceil(length / MAX_STEP - WHOLE), 1.0), step = length / parts;
    double *variables = memory->variables;
    double inputs[INPUTS + 1], states[STATES + 1], sums[STATES + 1];
    int are_finite = 1;

    memcpy(inputs, variables + FIRST_INPUT, INPUTS * sizeof inputs[0]);
    for (double part = 0.0; part < parts; part += 1.0) {
        memcpy(states, variables + FIRST_STATE, STATES * sizeof states[0]);
        memset(sums, 0, sizeof sums);
        for (int stage = 0; stage < 4; stage++) {
            const double elapsed = (part + shares[stage]) * step;
            variables[0] = start + elapsed;
            for (int index = 0; index < INPUTS; index++) {
                if (memory->slopes[index] != 0.0) {
                    variables[FIRST_INPUT + index] = inputs[index] + memory->slopes[index] * elapsed;
                }
            }
            for (int index = 0; index < STATES && stage > 0; index++) {
                const double rate = variables[FIRST_RATE + index];
                variables[FIRST_STATE + index] = states[index] + shares[stage] * step * rate;
            }
            if (drive != NULL) {
                drive(owner);
            }
            compute(variables[0] - memory->start, variables);
            for (int index = 0; index < STATES; index++) {
                sums[index] += weights[stage] * variables[FIRST_RATE + index];
            }
        }
        for (int index = 0; index < STATES; index++) {
            variables[FIRST_STATE + index] = states[index] + step / 6.0 * sums[index];
        }
    }
    for (int index = 0; index < STATES; index++) {
        are_finite = are_finite && isfinite(variables[FIRST_STATE + index]);
    }
    variables[0] = start + length;
    memset(memory->slopes, 0, sizeof memory->slopes);
    memory->is_current = 0;
    return are_finite;
}

#endif
