#include "policy.h"

#include <math.h>
#include <stddef.h>

#define LARGEST 1.0e30 /* of an observation over its scale, so that no sum can overflow */

/* PRINTED */
/* Clusters of the points that are left: k-means, as inspection.chief.points.cluster. */

static double distance_squared(const double a[3], const double b[3])
{
    const double x = a[0] - b[0];
    const double y = a[1] - b[1];
    const double z = a[2] - b[2];

    return (x * x) + (y * y) + (z * z);
}

/* Returns the squared distance from a place to the nearest living centre; infinite if there is none. */
static double nearest_squared(const struct policy_clusters *clusters, const double place[3])
{
    double least = HUGE_VAL;

    for (size_t k = 0U; k < POLICY_CLUSTERS; k++) {
        if (clusters->alive[k]) {
            least = fmin(least, distance_squared(clusters->centres[k], place));
        }
    }
    return least;
}

/* Puts a centre on the wanted point that is farthest from all living centres. */
static void seed(struct policy_clusters *clusters, size_t k, const bool wanted[POLICY_POINTS])
{
    double most = -1.0;

    for (size_t i = 0U; i < POLICY_POINTS; i++) {
        const double gap = nearest_squared(clusters, policy_points[i]);

        if (wanted[i] && (gap > most)) {
            most = gap;
            for (size_t j = 0U; j < 3U; j++) {
                clusters->centres[k][j] = policy_points[i][j];
            }
        }
    }
    clusters->alive[k] = true;
}

/* Writes the mean of the wanted points that are nearest to a living centre. Returns the number of these points. */
static double moved(const struct policy_clusters *clusters, size_t k, const bool wanted[POLICY_POINTS], double mean[3])
{
    double sum[3] = {0.0};
    double size = 0.0;

    for (size_t i = 0U; i < POLICY_POINTS; i++) {
        const double gap = distance_squared(clusters->centres[k], policy_points[i]);

        if (wanted[i] && clusters->alive[k] && (gap <= nearest_squared(clusters, policy_points[i]))) {
            size += 1.0;
            for (size_t j = 0U; j < 3U; j++) {
                sum[j] += policy_points[i][j];
            }
        }
    }
    for (size_t j = 0U; j < 3U; j++) {
        mean[j] = (size > 0.0) ? (sum[j] / size) : clusters->centres[k][j];
    }
    return size;
}

void policy_look(struct policy_clusters *clusters, const bool wanted[POLICY_POINTS], const double place[3],
                 double direction[3])
{
    double size[POLICY_CLUSTERS] = {0.0};
    size_t left = 0U;

    for (size_t i = 0U; i < POLICY_POINTS; i++) {
        left += wanted[i] ? 1U : 0U;
    }
    for (size_t k = 0U; k < POLICY_CLUSTERS; k++) {
        clusters->alive[k] = clusters->alive[k] && ((k * PER_CLUSTER) < left);
    }
    for (size_t k = 0U; k < POLICY_CLUSTERS; k++) {
        if (!clusters->alive[k] && ((k * PER_CLUSTER) < left)) {
            seed(clusters, k, wanted);
        }
    }
    for (size_t times = 0U; times < ITERATIONS; times++) {
        const struct policy_clusters before = *clusters;

        for (size_t k = 0U; k < POLICY_CLUSTERS; k++) {
            size[k] = moved(&before, k, wanted, clusters->centres[k]);
        }
    }
    for (size_t j = 0U; j < 3U; j++) {
        direction[j] = 0.0;
    }
    for (size_t k = 0U; k < POLICY_CLUSTERS; k++) {
        clusters->alive[k] = clusters->alive[k] && (size[k] > 0.0);
    }
    for (size_t k = 0U; k < POLICY_CLUSTERS; k++) {
        const double *const centre = clusters->centres[k];
        const double length = sqrt((centre[0] * centre[0]) + (centre[1] * centre[1]) + (centre[2] * centre[2]));

        if (clusters->alive[k] && (length > 0.0) &&
            (distance_squared(centre, place) <= nearest_squared(clusters, place))) {
            for (size_t j = 0U; j < 3U; j++) {
                direction[j] = centre[j] / length;
            }
        }
    }
}

/* observation */

void policy_observe(const double state[16], const double priority[3], const double uninspected[3],
                    const double score[1], const double chief[7], double observation[POLICY_OBSERVATIONS])
{
#if POLICY_OBSERVES_CHIEF
    observe(state, priority, uninspected, score, chief, observation);
#else
    (void)chief;
    observe(state, priority, uninspected, score, observation);
#endif
}

/* decision */

/* Returns the command for an action: sign(a) |a|^k, which is within [-1, 1]. */
static double shaped(double action)
{
    const double size = pow(fabs(action), POWER);

    return (action < 0.0) ? -size : size;
}

bool policy_control(const double observation[POLICY_OBSERVATIONS], double control[POLICY_CONTROLS])
{
    double from[WIDEST];
    double to[WIDEST];
    size_t n = 0U; /* index of the next number of WEIGHT */
    bool fine = true;

    for (size_t i = 0U; i < POLICY_OBSERVATIONS; i++) {
        from[i] = observation[i] / SCALE[i];
        if (!(fabs(from[i]) <= LARGEST)) { /* also true for NaN */
            fine = false;
            from[i] = 0.0;
        }
    }
    for (size_t layer = 0U; layer < LAYERS; layer++) {
        for (size_t i = 0U; i < SIZE[layer + 1U]; i++) {
            double sum = (double)WEIGHT[n];

            n++;
            for (size_t j = 0U; j < SIZE[layer]; j++) {
                sum += (double)WEIGHT[n] * from[j];
                n++;
            }
            to[i] = (TANH_OUTPUTS || ((layer + 1U) < LAYERS)) ? tanh(sum) : sum;
        }
        for (size_t i = 0U; i < SIZE[layer + 1U]; i++) {
            from[i] = to[i];
        }
    }
    for (size_t i = 0U; i < POLICY_CONTROLS; i++) {
        control[i] = fine ? (fmax(-1.0, fmin(1.0, shaped(from[i]))) * LIMIT[i]) : 0.0;
    }
    return fine;
}
