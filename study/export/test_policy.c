#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>

#include "policy.h"

#define TOLERANCE 1e-6 /* in units of the actuators' limits */

/* States, and PyTorch's controls, in the units of policy.h. */
/* PRINTED */

/* Returns the largest difference from PyTorch's controls; infinite if a control is not a number or beyond its limit. */
static double largest_difference(void)
{
    struct policy_clusters clusters = {.alive = {false}};
    double largest = 0.0;

    for (size_t n = 0U; n < VECTORS; n++) {
        bool wanted[POLICY_POINTS];
        double uninspected[3];
        double observation[POLICY_OBSERVATIONS];
        double control[POLICY_CONTROLS];
        bool fine;

        for (size_t i = 0U; i < POLICY_POINTS; i++) {
            wanted[i] = WANTED[n][i] == '1';
        }
        policy_look(&clusters, wanted, STATES[n], uninspected);
        policy_observe(STATES[n], PRIORITIES[n], uninspected, SCORES[n], CHIEFS[n], observation);
        fine = policy_control(observation, control);
        for (size_t i = 0U; i < POLICY_CONTROLS; i++) {
            const double difference = fabs(control[i] - EXPECTED[n][i]) / MOST[i];

            if (!fine || !(fabs(control[i]) <= MOST[i]) || !(difference >= 0.0)) {
                largest = HUGE_VAL;
            }
            largest = fmax(largest, difference);
        }
    }
    return largest;
}

/* Returns how many observations with a NaN or infinite component, 3 per component, are answered by false and zeros. */
static unsigned int refused(void)
{
    const double hostile[3] = {nan(""), HUGE_VAL, -HUGE_VAL};
    unsigned int count = 0U;

    for (size_t i = 0U; i < POLICY_OBSERVATIONS; i++) {
        for (size_t k = 0U; k < 3U; k++) {
            double observation[POLICY_OBSERVATIONS] = {0.0};
            double control[POLICY_CONTROLS];
            bool right;

            observation[i] = hostile[k];
            right = !policy_control(observation, control);
            for (size_t j = 0U; j < POLICY_CONTROLS; j++) {
                right = right && (fabs(control[j]) <= 0.0);
            }
            count += right ? 1U : 0U;
        }
    }
    return count;
}

int main(void)
{
    const double difference = largest_difference();
    const unsigned int hostile = 3U * POLICY_OBSERVATIONS;
    const unsigned int count = refused();
    const bool passed = (difference <= TOLERANCE) && (count == hostile);

    (void)printf("%s: at most %.1e of the limits from PyTorch over %u states, ", passed ? "passed" : "FAILED",
                 difference, VECTORS);
    (void)printf("%u of %u without a number refused\n", count, hostile);
    return passed ? EXIT_SUCCESS : EXIT_FAILURE;
}
