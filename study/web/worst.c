/* A plant with worst errors, call by call: the data of inspection.world.plant.Plant between calls, and decisions of
 * the adversary Greedy of study.verification.adversaries. A corner has 12 sensor errors and 6 gains, each 1 at its
 * upper end, and whether the call is missed.
 */

enum { BODY = 0, THRUST = 7, TORQUE = 16, LATENCY = 19, GAINS = 12, MISSED = 18 }; /* indices of `plant`, `corner` */

static double history[PAST + 1][16]; /* measured states, by call */
static double past[PAST + 1][6];     /* held controls, by call */
static double held[6];               /* control of the last call */
static int calls;
static int missed; /* missed calls in a row */

/* Returns the sum of the smallest margins a call later if the sensors are off by `error` along each axis; writes its
 * slope along one of the 12 errors or, from GAINS on, of the 6 controls.
 */
static double margin_after(const double u[6], double error, int which, double slope[1])
{
    double along[18] = {0.0};
    double errors[12];
    double margin[1];
    for (int i = 0; i < 12; ++i) {
        errors[i] = error;
    }
    along[which] = 1.0;
    outlook(state, errors, u, along, &along[GAINS], margin, slope);
    return margin[0];
}

void worst_begin(void)
{
    calls = 0;
    missed = 0;
    memset(held, 0, sizeof held);
}

/* Measures the state with the errors that make it look safest, and writes the controls that have been held since. */
void worst_sense(void)
{
    sent_count = ((int)plant[LATENCY] < calls) ? (int)plant[LATENCY] : calls;
    for (int i = 0; i < GAINS; ++i) {
        double slope[1];
        (void)margin_after(held, NEXT_TO_NOTHING, i, slope);
        corner[i] = (slope[0] > 0.0) ? 1.0 : 0.0;
    }
    sensed(state, corner, history[calls % (PAST + 1)]);
    memcpy(seen, history[(calls - sent_count) % (PAST + 1)], sizeof history[0]);
    for (int i = 0; i < sent_count; ++i) {
        memcpy(&sent[6 * i], past[(calls - sent_count + i) % (PAST + 1)], sizeof past[0]);
    }
}

/* Holds the call's control, or the last one if missing the call does more harm, and writes the acting control. */
void worst_hold(void)
{
    const int can_miss = (calls > 0) && (missed < MISSED_MOST);
    double slope[1];
    const int is_missed = can_miss && (margin_after(held, 0.0, 0, slope) < margin_after(control, 0.0, 0, slope));
    if (is_missed) {
        memcpy(control, held, sizeof held);
    }
    missed = is_missed ? (missed + 1) : 0;
    corner[MISSED] = is_missed ? 1.0 : 0.0;
    memcpy(held, control, sizeof held);
    memcpy(past[calls % (PAST + 1)], control, sizeof held);
    calls += 1;
    for (int j = GAINS; j < MISSED; ++j) {
        (void)margin_after(held, NEXT_TO_NOTHING, j, slope);
        corner[j] = ((slope[0] * held[j - GAINS]) < 0.0) ? 1.0 : 0.0;
    }
    actuated(&plant[THRUST], &plant[TORQUE], &corner[GAINS], control, acting);
}

void worst_fly(void)
{
    double y[16];
    moved(state, acting, &plant[BODY], y);
    memcpy(state, y, sizeof y);
}
