#include "fmi2Functions.h"
#include "motor.h"

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String place,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    Motor *m = type == fmi2CoSimulation ? malloc(sizeof *m) : NULL;
    (void)name, (void)token, (void)place, (void)functions, (void)visible, (void)logging;
    if (m) {
        restart(m);
    }
    return m;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2Reset(fmi2Component c) { restart(c); return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { refresh(c); return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { refresh(c); return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { (void)c; return fmi2OK; }

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real start, fmi2Boolean d, fmi2Real e)
{
    Motor *m = c;
    (void)a, (void)b, (void)d, (void)e;
    m->start = m->v[TIME] = start;
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference at[], size_t count, fmi2Real into[])
{
    Motor *m = c;
    refresh(m);
    for (size_t n = 0; n < count; n++) {
        if (at[n] >= COUNT) {
            return fmi2Error;
        }
        into[n] = m->v[at[n]];
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference at[], size_t count, const fmi2Real from[])
{
    Motor *m = c;
    for (size_t n = 0; n < count; n++) {
        int is_input = at[n] == VOLTAGE || at[n] == TORQUE;
        if (!is_input && (m->begun || at[n] < SPEED_START || at[n] >= POWER)) {
            return fmi2Error;
        }
        m->v[at[n]] = from[n];
    }
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real now, fmi2Real length, fmi2Boolean no_return)
{
    (void)no_return;
    go_on(c, now + length);
    return isfinite(((Motor *)c)->v[SPEED]) ? fmi2OK : fmi2Discard;
}
