/* An adapted twin as an FMU for co-simulation and model exchange, FMI 2.0. */

#include "fmi2Functions.h"
#include "instance.h"

typedef struct {
    Memory memory;
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    char *name;
    fmi2Boolean logging;
} Instance;

static fmi2Status fail(const Instance *instance, const char *message)
{
    if (instance->logger != NULL && instance->logging) {
        instance->logger(instance->environment, instance->name, fmi2Error, "logStatusError", "%s", message);
    }
    return fmi2Error;
}

static fmi2Status fail_with(const Instance *instance, const char *format, double number)
{
    char message[MESSAGE];
    snprintf(message, sizeof message, format, number);
    return fail(instance, message);
}

static fmi2Status unknown(const Instance *instance, size_t count, const char *message)
{
    return count == 0 ? fmi2OK : fail(instance, message);
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging)
{
    Instance *instance = calloc(1, sizeof *instance);
    (void)type, (void)resources, (void)visible;
    if (instance == NULL) {
        return NULL;
    }
    instance->name = calloc(strlen(name == NULL ? "" : name) + 1, 1);
    if (instance->name == NULL) {
        free(instance);
        return NULL;
    }
    strcpy(instance->name, name == NULL ? "" : name);
    if (callbacks != NULL) {
        instance->logger = callbacks->logger;
        instance->environment = callbacks->componentEnvironment;
    }
    instance->logging = fmi2True;
    if (guid == NULL || strcmp(guid, TOKEN) != 0) {
        fail(instance, "the guid is not that of this FMU: read it from its modelDescription.xml");
        free(instance->name);
        free(instance);
        return NULL;
    }
    instance->logging = logging;
    begin(&instance->memory);
    return instance;
}

void fmi2FreeInstance(fmi2Component component)
{
    Instance *instance = component;
    if (instance != NULL) {
        free(instance->name);
        free(instance);
    }
}

fmi2Status fmi2SetDebugLogging(fmi2Component component, fmi2Boolean logging, size_t count,
                               const fmi2String categories[])
{
    (void)count, (void)categories;
    ((Instance *)component)->logging = logging;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component component, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean has_stop, fmi2Real stop)
{
    Memory *memory = &((Instance *)component)->memory;
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    memory->start = start;
    set(memory, 0, start);
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component) { (void)component; return fmi2OK; }

fmi2Status fmi2ExitInitializationMode(fmi2Component component) { (void)component; return fmi2OK; }

fmi2Status fmi2Terminate(fmi2Component component) { (void)component; return fmi2OK; }

fmi2Status fmi2Reset(fmi2Component component)
{
    begin(&((Instance *)component)->memory);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component component, const fmi2ValueReference references[], size_t count, fmi2Real values[])
{
    Instance *instance = component;
    const double *variables = current(&instance->memory);
    for (size_t index = 0; index < count; index++) {
        if (references[index] >= VARIABLES) {
            return fail_with(instance, "no variable has the value reference %.0f", references[index]);
        }
        values[index] = variables[references[index]];
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component component, const fmi2ValueReference references[], size_t count,
                       const fmi2Real values[])
{
    Instance *instance = component;
    for (size_t index = 0; index < count; index++) {
        if (!may_set(references[index])) {
            return fail_with(instance, "no input, parameter or state has the value reference %.0f", references[index]);
        }
        set(&instance->memory, references[index], values[index]);
    }
    return fmi2OK;
}

#define NO_VARIABLES(Name, Type, Const)                                                                                \
    fmi2Status fmi2##Name(fmi2Component component, const fmi2ValueReference references[], size_t count,                \
                          Const Type values[])                                                                         \
    {                                                                                                                  \
        (void)references, (void)values;                                                                                \
        return unknown(component, count, "all variables are of the type Real");                                        \
    }
#define NOTHING
NO_VARIABLES(GetInteger, fmi2Integer, NOTHING)
NO_VARIABLES(GetBoolean, fmi2Boolean, NOTHING)
NO_VARIABLES(GetString, fmi2String, NOTHING)
NO_VARIABLES(SetInteger, fmi2Integer, const)
NO_VARIABLES(SetBoolean, fmi2Boolean, const)
NO_VARIABLES(SetString, fmi2String, const)

fmi2Status fmi2GetFMUstate(fmi2Component component, fmi2FMUstate *state)
{
    Instance *instance = component;
    if (*state == NULL) {
        *state = calloc(1, sizeof(Memory));
    }
    if (*state == NULL) {
        return fail(instance, "no memory is left");
    }
    memcpy(*state, &instance->memory, sizeof(Memory));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component component, fmi2FMUstate state)
{
    if (state == NULL) {
        return fail(component, "there is no such state of the FMU");
    }
    memcpy(&((Instance *)component)->memory, state, sizeof(Memory));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component component, fmi2FMUstate *state)
{
    (void)component;
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component component, fmi2FMUstate state, size_t *size)
{
    (void)component, (void)state;
    *size = sizeof(Memory);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component component, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    if (state == NULL || size != sizeof(Memory)) {
        return fail_with(component, "a state of this FMU has %.0f bytes", sizeof(Memory));
    }
    memcpy(bytes, state, size);
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component component, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    if (size != sizeof(Memory)) {
        return fail_with(component, "a state of this FMU has %.0f bytes", sizeof(Memory));
    }
    *state = malloc(size);
    if (*state == NULL) {
        return fail(component, "no memory is left");
    }
    memcpy(*state, bytes, size);
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknowns[],
                                        size_t unknown_count, const fmi2ValueReference knowns[], size_t known_count,
                                        const fmi2Real seed[], fmi2Real sensitivity[])
{
    (void)unknowns, (void)unknown_count, (void)knowns, (void)known_count, (void)seed, (void)sensitivity;
    return fail(component, "this FMU has no directional derivatives");
}

/* Model exchange */

fmi2Status fmi2EnterEventMode(fmi2Component component) { (void)component; return fmi2OK; }

fmi2Status fmi2NewDiscreteStates(fmi2Component component, fmi2EventInfo *info)
{
    (void)component;
    memset(info, 0, sizeof *info); /* all false: an event changes no state and no nominal value */
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component component) { (void)component; return fmi2OK; }

fmi2Status fmi2CompletedIntegratorStep(fmi2Component component, fmi2Boolean no_set_state, fmi2Boolean *enter_event_mode,
                                       fmi2Boolean *terminate)
{
    (void)component, (void)no_set_state;
    *enter_event_mode = *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component component, fmi2Real time)
{
    set(&((Instance *)component)->memory, 0, time);
    return fmi2OK;
}

static fmi2Status copy(Instance *instance, fmi2Real values[], size_t count, int first, int expected)
{
    if (count != (size_t)expected) {
        return fail_with(instance, "the number of values must be %.0f", expected);
    }
    memcpy(values, current(&instance->memory) + first, count * sizeof values[0]);
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component component, const fmi2Real values[], size_t count)
{
    Instance *instance = component;
    if (count != (size_t)STATES) {
        return fail_with(instance, "the number of states is %.0f", STATES);
    }
    memcpy(instance->memory.variables + FIRST_STATE, values, count * sizeof values[0]);
    instance->memory.is_current = 0;
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component component, fmi2Real values[], size_t count)
{
    return copy(component, values, count, FIRST_STATE, STATES);
}

fmi2Status fmi2GetDerivatives(fmi2Component component, fmi2Real values[], size_t count)
{
    return copy(component, values, count, FIRST_RATE, STATES);
}

fmi2Status fmi2GetEventIndicators(fmi2Component component, fmi2Real values[], size_t count)
{
    return copy(component, values, count, FIRST_INDICATOR, INDICATORS);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component component, fmi2Real values[], size_t count)
{
    if (count != (size_t)STATES) {
        return fail_with(component, "the number of states is %.0f", STATES);
    }
    memcpy(values, NOMINAL, count * sizeof values[0]);
    return fmi2OK;
}

/* Co-simulation */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component component, const fmi2ValueReference references[], size_t count,
                                       const fmi2Integer orders[], const fmi2Real values[])
{
    Instance *instance = component;
    for (size_t index = 0; index < count; index++) {
        if (!is_in(references[index], FIRST_INPUT, INPUTS) || orders[index] != 1) {
            return fail_with(instance, "no first derivative of an input is that of the value reference %.0f",
                             references[index]);
        }
        instance->memory.slopes[references[index] - FIRST_INPUT] = values[index];
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component component, const fmi2ValueReference references[], size_t count,
                                        const fmi2Integer orders[], fmi2Real values[])
{
    (void)references, (void)orders, (void)values;
    return unknown(component, count, "this FMU has no derivatives of outputs");
}

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real point, fmi2Real length, fmi2Boolean no_set_state)
{
    Instance *instance = component;
    (void)no_set_state;
    if (!(length >= 0.0 && isfinite(length) && isfinite(point))) {
        return fail_with(instance, "a step of %g s is not possible", length);
    }
    set(&instance->memory, 0, point);
    if (!advance(&instance->memory, length, NULL, NULL)) {
        return fail_with(instance, "the twin diverges before t = %g s: its values or inputs are the cause",
                         point + length);
    }
    set(&instance->memory, 0, point + length);
    return fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component component)
{
    return fail(component, "each step ends before fmi2DoStep returns");
}

#define STATUS(Name, Type)                                                                                             \
    fmi2Status fmi2##Name(fmi2Component component, const fmi2StatusKind kind, Type *value)                             \
    {                                                                                                                  \
        (void)component, (void)kind, (void)value;                                                                      \
        return fmi2Discard;                                                                                            \
    }
STATUS(GetStatus, fmi2Status)
STATUS(GetIntegerStatus, fmi2Integer)
STATUS(GetStringStatus, fmi2String)

fmi2Status fmi2GetRealStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Real *value)
{
    *value = ((Instance *)component)->memory.variables[0];
    return kind == fmi2LastSuccessfulTime ? fmi2OK : fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Boolean *value)
{
    (void)component;
    *value = fmi2False;
    return kind == fmi2Terminated ? fmi2OK : fmi2Discard;
}
