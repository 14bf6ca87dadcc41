#include "fmi3Functions.h"
#include "motor.h"

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String place, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference needed[], size_t count,
                                         fmi3InstanceEnvironment own, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    Motor *m = malloc(sizeof *m);
    (void)name, (void)token, (void)place, (void)visible, (void)logging, (void)events, (void)early, (void)needed;
    (void)count, (void)own, (void)log, (void)update;
    if (m) {
        restart(m);
    }
    return m;
}

void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3Reset(fmi3Instance c) { restart(c); return fmi3OK; }
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { refresh(c); return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { (void)c; return fmi3OK; }

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean a, fmi3Float64 b, fmi3Float64 start, fmi3Boolean d,
                                       fmi3Float64 e)
{
    Motor *m = c;
    (void)a, (void)b, (void)d, (void)e;
    m->start = m->v[TIME] = start;
    refresh(m);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3Float64 into[], size_t all)
{
    Motor *m = c;
    refresh(m);
    for (size_t n = 0; n < count; n++) {
        if (at[n] >= COUNT || all != count) {
            return fmi3Error;
        }
        into[n] = m->v[at[n]];
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference at[], size_t count, const fmi3Float64 from[],
                          size_t all)
{
    Motor *m = c;
    for (size_t n = 0; n < count; n++) {
        int is_input = at[n] == VOLTAGE || at[n] == TORQUE;
        if (all != count || (!is_input && (m->begun || at[n] < SPEED_START || at[n] >= POWER))) {
            return fmi3Error;
        }
        m->v[at[n]] = from[n];
    }
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 now, fmi3Float64 length, fmi3Boolean no_return, fmi3Boolean *event,
                      fmi3Boolean *ends, fmi3Boolean *early, fmi3Float64 *last)
{
    (void)no_return;
    go_on(c, now + length);
    *event = *ends = *early = fmi3False;
    *last = now + length;
    return isfinite(((Motor *)c)->v[SPEED]) ? fmi3OK : fmi3Discard;
}
