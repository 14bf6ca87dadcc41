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

/* The names of this version, for both_versions.h. */
#define FMI(Name) fmi2##Name
#define fmi2Handle fmi2Component
#define fmi2Number fmi2Real
#define fmi2SavedState fmi2FMUstate
#define fmi2GetSavedState fmi2GetFMUstate
#define fmi2SetSavedState fmi2SetFMUstate
#define fmi2FreeSavedState fmi2FreeFMUstate
#define fmi2SavedStateSize fmi2SerializedFMUstateSize
#define fmi2SerializeSavedState fmi2SerializeFMUstate
#define fmi2DeserializeSavedState fmi2DeSerializeFMUstate
#define fmi2GetRates fmi2GetDerivatives

#include "both_versions.h"

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
