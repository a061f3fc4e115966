/* An agent that decides how a deputy flies to inspect a chief. A decision is a call of policy_look, policy_observe and
 * policy_control. They allocate nothing, keep nothing but the clusters that they are given, and need math.h alone.
 * inspection/observation.py says what is observed.
 */
#ifndef POLICY_H
#define POLICY_H

#include <stdbool.h>

#ifdef __cplusplus
extern "C" {
#endif

/* PRINTED */
/* Where the clusters are of the points that are lit and not inspected yet. They follow from the last ones, so keep them
 * from look to look; zeros begin an episode.
 */
struct policy_clusters {
    double centres[POLICY_CLUSTERS][3]; /* m, in the chief's frame */
    bool alive[POLICY_CLUSTERS];
};

/* The chief's points in m, in its frame; that of a chief that does not turn is Hill's. */
extern const double policy_points[POLICY_POINTS][3];

/* Says in which direction the nearest cluster is, as a vector of length 1, or zeros where none is left.
 * `wanted`: which points are lit and not inspected yet. `place` of the deputy and `direction` are in the chief's frame.
 */
void policy_look(struct policy_clusters *clusters, const bool wanted[POLICY_POINTS], const double place[3],
                 double direction[3]);

/* Computes what the agent observes in a state.
 * `priority`: the direction around which the chief's points weigh most. `uninspected`: what policy_look says. Both are
 * in Hill's frame. `score`: weight of the points inspected so far, of 1. `chief`: its attitude, a quaternion from its
 * frame to Hill's, and its rate in its frame in rad/s; it is read only where POLICY_OBSERVES_CHIEF is 1.
 */
void policy_observe(const double state[16], const double priority[3], const double uninspected[3],
                    const double score[1], const double chief[7], double observation[POLICY_OBSERVATIONS]);

/* Decides on the control, to be held for POLICY_PERIOD. Returns true; or false, and a control of zeros, where a
 * component of the observation is not a number or beyond 1e30 times its usual size.
 */
bool policy_control(const double observation[POLICY_OBSERVATIONS], double control[POLICY_CONTROLS]);

#ifdef __cplusplus
}
#endif

#endif
