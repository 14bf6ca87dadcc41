/* An adapted twin as an FMU for co-simulation and model exchange, FMI 3.0. */

#include "fmi3Functions.h"
#include "instance.h"

typedef struct {
    Memory memory;
    fmi3LogMessageCallback log;
    fmi3IntermediateUpdateCallback update; /* NULL if the importer sets no input within a step */
    fmi3InstanceEnvironment environment;
    fmi3Boolean logging;
} Instance;

static fmi3Status fail(const Instance *instance, const char *message)
{
    if (instance->log != NULL && instance->logging) {
        instance->log(instance->environment, fmi3Error, "logStatusError", message);
    }
    return fmi3Error;
}

/* The names of this version, for both_versions.h. */
#define FMI(Name) fmi3##Name
#define fmi3Handle fmi3Instance
#define fmi3Number fmi3Float64
#define fmi3SavedState fmi3FMUState
#define fmi3GetSavedState fmi3GetFMUState
#define fmi3SetSavedState fmi3SetFMUState
#define fmi3FreeSavedState fmi3FreeFMUState
#define fmi3SavedStateSize fmi3SerializedFMUStateSize
#define fmi3SerializeSavedState fmi3SerializeFMUState
#define fmi3DeserializeSavedState fmi3DeserializeFMUState
#define fmi3GetRates fmi3GetContinuousStateDerivatives

#include "both_versions.h"

static Instance *instantiate(fmi3String token, fmi3Boolean logging, fmi3InstanceEnvironment environment,
                             fmi3LogMessageCallback log)
{
    Instance *instance = calloc(1, sizeof *instance);
    if (instance == NULL) {
        return NULL;
    }
    instance->environment = environment;
    instance->log = log;
    instance->logging = fmi3True;
    if (token == NULL || strcmp(token, TOKEN) != 0) {
        fail(instance, "the instantiation token is not that of this FMU: read it from its modelDescription.xml");
        free(instance);
        return NULL;
    }
    instance->logging = logging;
    begin(&instance->memory);
    return instance;
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)name, (void)resources, (void)visible;
    return instantiate(token, logging, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode_used, fmi3Boolean early_return,
                                         const fmi3ValueReference intermediate[], size_t intermediate_count,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    Instance *instance = instantiate(token, logging, environment, log);
    (void)name, (void)resources, (void)visible, (void)event_mode_used, (void)early_return, (void)intermediate;
    if (instance != NULL && intermediate_count > 0) {
        instance->update = update;
    }
    return instance;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)clock, (void)lock, (void)unlock;
    if (log != NULL) {
        log(environment, fmi3Error, "logStatusError", "this FMU has no scheduled execution");
    }
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop)
{
    Memory *memory = &((Instance *)instance)->memory;
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    memory->start = start;
    set(memory, 0, start);
    return fmi3OK;
}

#define MODE(Name)                                                                                                     \
    fmi3Status fmi3##Name(fmi3Instance instance)                                                                       \
    {                                                                                                                  \
        (void)instance;                                                                                                \
        return fmi3OK;                                                                                                 \
    }
MODE(ExitInitializationMode)
MODE(EnterEventMode)
MODE(EnterContinuousTimeMode)
MODE(EnterStepMode)
MODE(Terminate)
MODE(EnterConfigurationMode)
MODE(ExitConfigurationMode)
MODE(EvaluateDiscreteStates)

fmi3Status fmi3GetFloat64(fmi3Instance own, const fmi3ValueReference references[], size_t count, fmi3Float64 values[],
                          size_t value_count)
{
    Instance *instance = own;
    const double *variables = current(&instance->memory);
    for (size_t index = 0; index < count; index++) {
        if (references[index] >= VARIABLES || index >= value_count) {
            return fail_with(instance, "no variable has the value reference %.0f", references[index]);
        }
        values[index] = variables[references[index]];
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance own, const fmi3ValueReference references[], size_t count,
                          const fmi3Float64 values[], size_t value_count)
{
    Instance *instance = own;
    for (size_t index = 0; index < count; index++) {
        if (!may_set(references[index]) || index >= value_count) {
            return fail_with(instance, "no input, parameter or state has the value reference %.0f", references[index]);
        }
        set(&instance->memory, references[index], values[index]);
    }
    return fmi3OK;
}

#define NO_VARIABLES(Name)                                                                                             \
    fmi3Status fmi3Get##Name(fmi3Instance instance, const fmi3ValueReference references[], size_t count,               \
                             fmi3##Name values[], size_t value_count)                                                  \
    {                                                                                                                  \
        (void)references, (void)values, (void)value_count;                                                             \
        return unknown(instance, count, "all variables are of the type Float64");                                      \
    }                                                                                                                  \
    fmi3Status fmi3Set##Name(fmi3Instance instance, const fmi3ValueReference references[], size_t count,               \
                             const fmi3##Name values[], size_t value_count)                                            \
    {                                                                                                                  \
        (void)references, (void)values, (void)value_count;                                                             \
        return unknown(instance, count, "all variables are of the type Float64");                                      \
    }
NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference references[], size_t count, size_t sizes[],
                         fmi3Binary values[], size_t value_count)
{
    (void)references, (void)sizes, (void)values, (void)value_count;
    return unknown(instance, count, "all variables are of the type Float64");
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                         const size_t sizes[], const fmi3Binary values[], size_t value_count)
{
    (void)references, (void)sizes, (void)values, (void)value_count;
    return unknown(instance, count, "all variables are of the type Float64");
}

#define NO_CLOCKS(Name, Type)                                                                                          \
    fmi3Status fmi3##Name(fmi3Instance instance, const fmi3ValueReference references[], size_t count, Type values[])   \
    {                                                                                                                  \
        (void)references, (void)values;                                                                                \
        return unknown(instance, count, "this FMU has no clocks");                                                     \
    }
NO_CLOCKS(GetClock, fmi3Clock)
NO_CLOCKS(SetClock, const fmi3Clock)
NO_CLOCKS(GetShiftDecimal, fmi3Float64)
NO_CLOCKS(SetIntervalDecimal, const fmi3Float64)
NO_CLOCKS(SetShiftDecimal, const fmi3Float64)

#define NO_CLOCKS_BY_TWO(Name, First, Second)                                                                          \
    fmi3Status fmi3##Name(fmi3Instance instance, const fmi3ValueReference references[], size_t count, First first[],   \
                          Second second[])                                                                             \
    {                                                                                                                  \
        (void)references, (void)first, (void)second;                                                                   \
        return unknown(instance, count, "this FMU has no clocks");                                                     \
    }
NO_CLOCKS_BY_TWO(GetIntervalDecimal, fmi3Float64, fmi3IntervalQualifier)
NO_CLOCKS_BY_TWO(GetShiftFraction, fmi3UInt64, fmi3UInt64)
NO_CLOCKS_BY_TWO(SetIntervalFraction, const fmi3UInt64, const fmi3UInt64)
NO_CLOCKS_BY_TWO(SetShiftFraction, const fmi3UInt64, const fmi3UInt64)

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                                   fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[])
{
    (void)references, (void)counters, (void)resolutions, (void)qualifiers;
    return unknown(instance, count, "this FMU has no clocks");
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference reference, fmi3Float64 time)
{
    (void)reference, (void)time;
    return fail(instance, "this FMU has no clocks");
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance, fmi3ValueReference reference, size_t *count)
{
    (void)reference;
    *count = 0;
    return fail(instance, "the dependencies of variables are in modelDescription.xml");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent, size_t of_dependent[],
                                       fmi3ValueReference independents[], size_t of_independents[],
                                       fmi3DependencyKind kinds[], size_t count)
{
    (void)dependent, (void)of_dependent, (void)independents, (void)of_independents, (void)kinds, (void)count;
    return fail(instance, "the dependencies of variables are in modelDescription.xml");
}

#define NO_DERIVATIVES(Name)                                                                                           \
    fmi3Status fmi3##Name(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t unknown_count,            \
                          const fmi3ValueReference knowns[], size_t known_count, const fmi3Float64 seed[],             \
                          size_t seed_count, fmi3Float64 sensitivity[], size_t sensitivity_count)                      \
    {                                                                                                                  \
        (void)unknowns, (void)unknown_count, (void)knowns, (void)known_count, (void)seed, (void)seed_count,            \
            (void)sensitivity, (void)sensitivity_count;                                                                \
        return fail(instance, "this FMU has neither directional nor adjoint derivatives");                             \
    }
NO_DERIVATIVES(GetDirectionalDerivative)
NO_DERIVATIVES(GetAdjointDerivative)

/* Model exchange */

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *need_update, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals_changed, fmi3Boolean *states_changed,
                                    fmi3Boolean *has_next_event, fmi3Float64 *next_event)
{
    (void)instance; /* an event changes no state and no nominal value */
    *need_update = *terminate = *nominals_changed = *states_changed = *has_next_event = fmi3False;
    *next_event = 0.0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *count)
{
    (void)instance;
    *count = (size_t)INDICATORS;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *count)
{
    (void)instance;
    *count = (size_t)STATES;
    return fmi3OK;
}

/* Co-simulation */

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
                                    const fmi3Int32 orders[], fmi3Float64 values[], size_t value_count)
{
    (void)references, (void)orders, (void)values, (void)value_count;
    return unknown(instance, count, "this FMU has no derivatives of outputs");
}

/* Let the importer set the inputs of the present time, at which the integrator needs the derivatives. */
static void ask_for_inputs(void *owner)
{
    Instance *instance = owner;
    fmi3Boolean early_return = fmi3False;
    fmi3Float64 early_return_time = 0.0;
    instance->update(instance->environment, instance->memory.variables[0], fmi3True, fmi3False, fmi3False, fmi3False,
                     &early_return, &early_return_time);
}

fmi3Status fmi3DoStep(fmi3Instance own, fmi3Float64 point, fmi3Float64 length, fmi3Boolean no_set_state,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early_return,
                      fmi3Float64 *last_time)
{
    Instance *instance = own;
    (void)no_set_state;
    *event_needed = *terminate = *early_return = fmi3False;
    *last_time = point;
    if (!(length >= 0.0 && isfinite(length) && isfinite(point))) {
        return fail_with(instance, "a step of %g s is not possible", length);
    }
    set(&instance->memory, 0, point);
    if (!advance(&instance->memory, length, instance->update == NULL ? NULL : ask_for_inputs, instance)) {
        return fail_with(instance, "the twin diverges before t = %g s: its values or inputs are the cause",
                         point + length);
    }
    set(&instance->memory, 0, point + length);
    *last_time = point + length;
    return fmi3OK;
}
