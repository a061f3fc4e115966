/* The agent's part in a flight: it looks, and decides; see policy.h. */
#include "policy.h"

static struct policy_clusters clusters;
static double left[3]; /* the direction of the nearest cluster of points that are lit and left */

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

/* The agent's decision, into `desired`. */
void agent_decide(void)
{
    double observation[POLICY_OBSERVATIONS];
    policy_observe(seen, priority, left, score, 0, observation);
    (void)policy_control(observation, desired);
}
