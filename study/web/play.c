/* A flight for a page: the state, and the model. Its arrays are in play.h. */

/* Writes the constraints' values now, and which failures have occurred. */
void judge(void)
{
    constraint_values(state, values);
    failures(state, failed);
}

/* Marks the points in view as inspected, and adds up their weights. */
void look(void)
{
    double in_sight[POINTS];
    in_view(state, lit, in_sight);
    score[0] = 0.0;
    for (int i = 0; i < POINTS; ++i) {
        inspected[i] = ((inspected[i] > 0.0) || (in_sight[i] > 0.0)) ? 1.0 : 0.0;
        score[0] += inspected[i] * weights[i];
    }
}

/* Starts from `state` and `priority`. */
void begin(void)
{
    sent_count = 0;
    point_weights(priority, weights);
}

/* Flies one step under the acting control. */
void fly(void)
{
    double y[16];
    model_step(state, acting, y);
    memcpy(state, y, sizeof y);
}

/* Writes full control against the rows that are closest to a violation into `desired`. */
void attack(void)
{
    adversary(seen, desired);
}

/* Writes the free flight into `ahead`, a point every `steps` steps. */
void coast(int steps)
{
    static const double nothing[6] = {0.0};
    double x[16];
    double y[16];
    memcpy(x, state, sizeof x);
    for (int i = 0; i < PLACES; ++i) {
        memcpy(&ahead[3 * i], x, 3 * sizeof x[0]);
        for (int s = 0; s < steps; ++s) {
            model_step(x, nothing, y);
            memcpy(x, y, sizeof x);
        }
    }
}
