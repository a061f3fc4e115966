/* What an agent is shown beside the state, and what it decides. */

void clusters_begin(void);
void clusters_settle(const int wanted[POINTS]);
const float *clusters_centres(void);
const int *clusters_alive(void);

static double left[3]; /* the direction of the nearest cluster of lit points that are left */

void agent_begin(void)
{
    clusters_begin();
}

void agent_look(const double x[16], const double lit[POINTS], const double inspected[POINTS])
{
    int wanted[POINTS];
    double centres[3 * CLUSTERS];
    for (int i = 0; i < POINTS; ++i) {
        wanted[i] = (lit[i] > 0.0) && !(inspected[i] > 0.0);
    }
    clusters_settle(wanted);
    for (int i = 0; i < 3 * CLUSTERS; ++i) {
        centres[i] = (double)clusters_centres()[i];
    }
    nearest(centres, clusters_alive(), x, left);
}

void agent_decide(const double x[16], const double priority[3], const double score[1], double u[6])
{
    double observation[POLICY_OBSERVATIONS];
    observe(x, priority, left, score, observation);
    (void)policy_control(observation, u);
}
