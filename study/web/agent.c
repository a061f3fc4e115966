/* The agent in a flight: it inspects, and decides; see policy.h. */
#include "policy.h"

static struct policy_clusters clusters;
static double left[3]; /* direction of the closest cluster of lit points that are not inspected */

void agent_begin(void)
{
    clusters = (struct policy_clusters){0};
}

void agent_look(void)
{
    bool wanted[POINTS];
    for (int i = 0; i < POINTS; ++i) {
        wanted[i] = (lit[i] > 0.0) && !(inspected[i] > 0.0);
    }
    policy_look(&clusters, wanted, state, left);
}

/* Writes the agent's decision into `desired`. */
void agent_decide(void)
{
    double observation[POLICY_OBSERVATIONS];
    policy_observe(seen, priority, left, score, 0, observation);
    (void)policy_control(observation, desired);
}
