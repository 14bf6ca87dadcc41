/* Functions of FMI that are the same in versions 2.0 and 3.0 but for their names.

   FMI(Name) is the name of the version. Before this file, Instance and fail() are defined, and what the version calls
   otherwise. */

#ifndef OTOLITH_BOTH_VERSIONS_H
#define OTOLITH_BOTH_VERSIONS_H

static FMI(Status) fail_with(const Instance *instance, const char *format, double number)
{
    char message[MESSAGE];
    snprintf(message, sizeof message, format, number);
    return fail(instance, message);
}

static FMI(Status) unknown(const Instance *instance, size_t count, const char *message)
{
    return count == 0 ? FMI(OK) : fail(instance, message);
}

FMI(Status) FMI(SetDebugLogging)(FMI(Handle) own, FMI(Boolean) logging, size_t count, const FMI(String) categories[])
{
    (void)count, (void)categories;
    ((Instance *)own)->logging = logging;
    return FMI(OK);
}

FMI(Status) FMI(Reset)(FMI(Handle) own)
{
    begin(&((Instance *)own)->memory);
    return FMI(OK);
}

FMI(Status) FMI(GetSavedState)(FMI(Handle) own, FMI(SavedState) *state)
{
    Instance *instance = own;
    if (*state == NULL) {
        *state = calloc(1, sizeof(Memory));
    }
    if (*state == NULL) {
        return fail(instance, "no memory is left");
    }
    memcpy(*state, &instance->memory, sizeof(Memory));
    return FMI(OK);
}

FMI(Status) FMI(SetSavedState)(FMI(Handle) own, FMI(SavedState) state)
{
    if (state == NULL) {
        return fail(own, "there is no such state of the FMU");
    }
    memcpy(&((Instance *)own)->memory, state, sizeof(Memory));
    return FMI(OK);
}

FMI(Status) FMI(FreeSavedState)(FMI(Handle) own, FMI(SavedState) *state)
{
    (void)own;
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return FMI(OK);
}

FMI(Status) FMI(SavedStateSize)(FMI(Handle) own, FMI(SavedState) state, size_t *size)
{
    (void)own, (void)state;
    *size = sizeof(Memory);
    return FMI(OK);
}

FMI(Status) FMI(SerializeSavedState)(FMI(Handle) own, FMI(SavedState) state, FMI(Byte) bytes[], size_t size)
{
    if (state == NULL || size != sizeof(Memory)) {
        return fail_with(own, "a state of this FMU has %.0f bytes", sizeof(Memory));
    }
    memcpy(bytes, state, size);
    return FMI(OK);
}

FMI(Status) FMI(DeserializeSavedState)(FMI(Handle) own, const FMI(Byte) bytes[], size_t size, FMI(SavedState) *state)
{
    if (size != sizeof(Memory)) {
        return fail_with(own, "a state of this FMU has %.0f bytes", sizeof(Memory));
    }
    *state = malloc(size);
    if (*state == NULL) {
        return fail(own, "no memory is left");
    }
    memcpy(*state, bytes, size);
    return FMI(OK);
}

/* Model exchange */

FMI(Status) FMI(CompletedIntegratorStep)(FMI(Handle) own, FMI(Boolean) no_set_state, FMI(Boolean) *enter_event_mode,
                                         FMI(Boolean) *terminate)
{
    (void)own, (void)no_set_state;
    *enter_event_mode = *terminate = FMI(False);
    return FMI(OK);
}

FMI(Status) FMI(SetTime)(FMI(Handle) own, FMI(Number) time)
{
    set(&((Instance *)own)->memory, 0, time);
    return FMI(OK);
}

static FMI(Status) copy(Instance *instance, FMI(Number) values[], size_t count, int first, int expected)
{
    if (count != (size_t)expected) {
        return fail_with(instance, "the number of values must be %.0f", expected);
    }
    memcpy(values, current(&instance->memory) + first, count * sizeof values[0]);
    return FMI(OK);
}

FMI(Status) FMI(SetContinuousStates)(FMI(Handle) own, const FMI(Number) values[], size_t count)
{
    Instance *instance = own;
    if (count != (size_t)STATES) {
        return fail_with(instance, "the number of states is %.0f", STATES);
    }
    memcpy(instance->memory.variables + FIRST_STATE, values, count * sizeof values[0]);
    instance->memory.is_current = 0;
    return FMI(OK);
}

FMI(Status) FMI(GetContinuousStates)(FMI(Handle) own, FMI(Number) values[], size_t count)
{
    return copy(own, values, count, FIRST_STATE, STATES);
}

FMI(Status) FMI(GetRates)(FMI(Handle) own, FMI(Number) values[], size_t count)
{
    return copy(own, values, count, FIRST_RATE, STATES);
}

FMI(Status) FMI(GetEventIndicators)(FMI(Handle) own, FMI(Number) values[], size_t count)
{
    return copy(own, values, count, FIRST_INDICATOR, INDICATORS);
}

FMI(Status) FMI(GetNominalsOfContinuousStates)(FMI(Handle) own, FMI(Number) values[], size_t count)
{
    if (count != (size_t)STATES) {
        return fail_with(own, "the number of states is %.0f", STATES);
    }
    memcpy(values, NOMINAL, count * sizeof values[0]);
    return FMI(OK);
}

#endif
