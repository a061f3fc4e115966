/* An agent that decides how a deputy flies to inspect a chief. A decision is a call of policy_look, policy_observe and
 * policy_control. These functions allocate nothing, keep no state except the given clusters, and need only math.h.
 * inspection/observation.py defines the observation.
 */
#ifndef POLICY_H
#define POLICY_H

#include <stdbool.h>

#ifdef __cplusplus
extern "C" {
#endif

/* PRINTED */
/* The clusters of the points that are lit and not inspected yet. New clusters follow from the last ones, so keep them
 * from look to look; zeros begin an episode.
 */
struct policy_clusters {
    double centres[POLICY_CLUSTERS][3]; /* m, in the chief's frame */
    bool alive[POLICY_CLUSTERS];
};

/* The chief's points in m, in its frame; for a chief that does not turn this is Hill's frame. */
extern const double policy_points[POLICY_POINTS][3];

/* Writes the direction of the nearest cluster, a vector of length 1, or zeros if no cluster is left.
 * `wanted`: which points are lit and not inspected yet. `place` of the deputy and `direction` are in the chief's frame.
 */
void policy_look(struct policy_clusters *clusters, const bool wanted[POLICY_POINTS], const double place[3],
                 double direction[3]);

/* Computes the agent's observation in a state.
 * `priority`: the direction around which the chief's points weigh most. `uninspected`: `direction` of policy_look. Both
 * are in Hill's frame. `score`: weight of the points inspected so far, of 1. `chief`: its attitude, a quaternion from
 * its frame to Hill's, and its rate in its frame in rad/s; it is read only if POLICY_OBSERVES_CHIEF is 1.
 */
void policy_observe(const double state[16], const double priority[3], const double uninspected[3],
                    const double score[1], const double chief[7], double observation[POLICY_OBSERVATIONS]);

/* Decides on the control, to be held for POLICY_PERIOD. Returns true; or false, and a control of zeros, if a
 * component of the observation is not a number or beyond 1e30 times its usual size.
 */
bool policy_control(const double observation[POLICY_OBSERVATIONS], double control[POLICY_CONTROLS]);

#ifdef __cplusplus
}
#endif

#endif
