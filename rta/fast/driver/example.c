/* A closed loop of 100 s: a pilot who asks for the worst, the filter behind it, and the model of the spacecraft. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "safety_filter.h"

#define DURATION 100.0 /* s */
#define SUBSTEP 1.0    /* s, of the model */

/* The state after SUBSTEP under a control that is held. */
static void model_step(const double x[16], const double u[6], double y[16]);

/* Full thrust towards the chief, and full torque about an axis that changes every 20 s. */
static void pilot(double time, const double x[16], double desired[6])
{
    const double distance = sqrt((x[0] * x[0]) + (x[1] * x[1]) + (x[2] * x[2]));
    const int axis = ((int)(time / 20.0)) % 3;
    for (int j = 0; j < 3; ++j) {
        desired[j] = -2.0 * SAFETY_FILTER_THRUST * x[j] / distance;
        desired[3 + j] = (j == axis) ? SAFETY_FILTER_TORQUE : 0.0;
    }
}

static void fly_a_period(double x[16], const double control[6])
{
    for (int i = 0; i < (int)(SAFETY_FILTER_PERIOD / SUBSTEP); ++i) {
        double y[16];
        model_step(x, control, y);
        for (int k = 0; k < 16; ++k) {
            x[k] = y[k];
        }
    }
}

int main(void)
{
    struct safety_filter_input in = {0};
    double lowest[SAFETY_FILTER_CONSTRAINTS];
    int calls[4] = {0}; /* by status */
    int violated = 0;
    in.state[SAFETY_FILTER_STATE_POSITION_Y] = -200.0;
    in.state[SAFETY_FILTER_STATE_ATTITUDE_W] = 1.0;
    in.state[SAFETY_FILTER_STATE_TEMPERATURE] = 5.0;
    in.state[SAFETY_FILTER_STATE_ENERGY] = 4.0;
    in.state[SAFETY_FILTER_STATE_SUN] = 2.0;
    for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
        lowest[k] = INFINITY;
    }
    for (double time = 0.0; time < DURATION; time += SAFETY_FILTER_PERIOD) {
        struct safety_filter_output out;
        pilot(time, in.state, in.desired);
        safety_filter(&in, &out);
        calls[out.status] += 1;
        for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
            lowest[k] = fmin(lowest[k], out.h[k]);
            violated += (out.h[k] < 0.0) ? 1 : 0;
        }
        fly_a_period(in.state, out.control);
    }
    for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
        (void)printf("%-22s h at least %11.4g\n", safety_filter_names[k], lowest[k]);
    }
    (void)printf("calls: %d as desired, %d corrected, %d with slack, %d unsolved; %d violations\n",
                 calls[SAFETY_FILTER_UNTOUCHED], calls[SAFETY_FILTER_HARD], calls[SAFETY_FILTER_SLACK],
                 calls[SAFETY_FILTER_UNSOLVED], violated);
    return (violated == 0) ? EXIT_SUCCESS : EXIT_FAILURE;
}
