/* Whether safety_filter.c answers as the filter in Python does. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "safety_filter.h"
#include "safety_filter_vectors.h"

static const double limit[2] = {SAFETY_FILTER_THRUST, SAFETY_FILTER_TORQUE};

/* Of two numbers, in a unit; infinite where one is none. */
static double difference(double a, double b, double unit)
{
    const double off = fabs(a - b) / unit;
    return (off >= 0.0) ? off : INFINITY;
}

/* Of the controls, in units of the actuators' limits; infinite where one is beyond them. */
static double off_control(int n, const struct safety_filter_output *out)
{
    double most = 0.0;
    for (int j = 0; j < 6; ++j) {
        const double off = difference(out->control[j], expected_control[n][j], limit[j / 3]);
        most = fmax(most, (fabs(out->control[j]) <= limit[j / 3]) ? off : INFINITY);
    }
    return most;
}

/* Of the constraints' values, relative to those above 1; a state that holds no number is not asked for any. */
static double off_values(int n, const struct safety_filter_output *out)
{
    double most = 0.0;
    for (int k = 0; (k < SAFETY_FILTER_CONSTRAINTS) && (out->status != SAFETY_FILTER_UNSOLVED); ++k) {
        const double size = fabs(expected_h[n][k]);
        most = fmax(most, difference(out->h[k], expected_h[n][k], fmax(size, 1.0)));
    }
    return most;
}

int main(void)
{
    double control = 0.0;
    double values = 0.0;
    int others = 0; /* with another status, another answer of the check, or other active constraints */
    for (int n = 0; n < VECTORS; ++n) {
        struct safety_filter_output out;
        safety_filter(&given[n], &out);
        int same = (out.status == expected_status[n]) ? 1 : 0;
        if ((out.verified != expected_verified[n]) || (out.backup != expected_backup[n])) {
            same = 0;
        }
        if ((out.status != SAFETY_FILTER_UNSOLVED) && (out.violated != expected_violated[n])) {
            same = 0;
        }
        for (int k = 0; (k < SAFETY_FILTER_CONSTRAINTS) && (out.status != SAFETY_FILTER_UNSOLVED); ++k) {
            same = ((same != 0) && (out.active[k] == expected_active[n][k])) ? 1 : 0;
        }
        others += (same != 0) ? 0 : 1;
        control = fmax(control, off_control(n, &out));
        values = fmax(values, off_values(n, &out));
    }
    const int passed = ((control <= TOLERANCE) && (values <= TOLERANCE_OF_H) && (others == 0)) ? 1 : 0;
    (void)printf("%s: %d calls, %d with another status, check or active constraints; controls at most %.1e of the "
                 "limits from Python's, h %.1e\n", (passed != 0) ? "passed" : "FAILED", VECTORS, others, control, values);
    return (passed != 0) ? EXIT_SUCCESS : EXIT_FAILURE;
}
