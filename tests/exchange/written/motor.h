/* A DC motor as somebody else writes it: named by hand, with a fixed step of Heun's method, and start values that are
   parameters. It can neither save its state nor show a derivative. */

#include <math.h>
#include <stdlib.h>

enum { TIME, VOLTAGE, TORQUE, SPEED, CURRENT, SPEED_START, CURRENT_START, R, L, INERTIA, K, FRICTION, POWER, COUNT };

static const double STEP = 1e-3; /* s */

typedef struct {
    double v[COUNT];
    long steps; /* since the start */
    double start;
    int begun;
} Motor;

static void restart(Motor *m)
{
    static const double values[COUNT] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, R_0, L_0, J_0, K_0, D_0, 0.0};
    for (int n = 0; n < COUNT; n++) {
        m->v[n] = values[n];
    }
    m->steps = 0;
    m->start = 0.0;
    m->begun = 0;
}

static void slope(const double *v, double speed, double current, double *of_speed, double *of_current)
{
    *of_speed = (v[K] * current - v[TORQUE] - v[FRICTION] * speed) / v[INERTIA];
    *of_current = (v[VOLTAGE] - v[R] * current - v[K] * speed) / v[L];
}

/* What follows from the others before the first step. */
static void refresh(Motor *m)
{
    if (!m->begun) {
        m->v[SPEED] = m->v[SPEED_START];
        m->v[CURRENT] = m->v[CURRENT_START];
    }
    m->v[POWER] = m->v[VOLTAGE] * m->v[CURRENT];
}

static void go_on(Motor *m, double until)
{
    double *v = m->v, a, b, c, d;
    refresh(m);
    m->begun = 1;
    while (m->start + (double)(m->steps + 1) * STEP <= until + 0.01 * STEP) {
        slope(v, v[SPEED], v[CURRENT], &a, &b);
        slope(v, v[SPEED] + STEP * a, v[CURRENT] + STEP * b, &c, &d);
        v[SPEED] += STEP * (a + c) / 2.0;
        v[CURRENT] += STEP * (b + d) / 2.0;
        m->steps++;
    }
    v[TIME] = until;
    refresh(m);
}
