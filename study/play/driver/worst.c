/* A world whose errors are at their worst, call by call, as inspection.world.plant and the adversary Greedy of
 * study.verification.adversaries have it. A plant is in the order of study.play.worst.plants. A corner has 12 errors of the
 * sensors and 6 gains, 1 at their upper end, and whether the call is missed. */

enum { BODY = 0, THRUST = 7, TORQUE = 16, LATENCY = 19, ERRORS = 12, GAINS = 6, MISSED = 18 };

static double history[PAST + 1][16]; /* what was measured, by call */
static double past[PAST + 1][6];     /* what was held, by call */
static double held[6];               /* what the last call gave, and the adversary goes by */
static int calls;
static int missed; /* calls in a row */

static void copy(double *x, const double *y, int size)
{
    for (int i = 0; i < size; ++i) {
        x[i] = y[i];
    }
}

static int lesser(int a, int b)
{
    return (a < b) ? a : b;
}

/* The smallest margins a call later, added up. */
static double margin_after(const double x[16], const double u[6])
{
    static const double nothing[ERRORS] = {0.0};
    double margin[1];
    double slope[1];
    outlook(x, nothing, u, nothing, nothing, margin, slope);
    return margin[0];
}

/* How they change with an error, or with a control whose number is ERRORS more. */
static double slope_along(const double x[16], const double u[6], int which)
{
    double along[ERRORS + GAINS] = {0.0};
    double error[ERRORS];
    double margin[1];
    double slope[1];
    for (int i = 0; i < ERRORS; ++i) {
        error[i] = NEXT_TO_NOTHING;
    }
    along[which] = 1.0;
    outlook(x, error, u, along, &along[ERRORS], margin, slope);
    return slope[0];
}

void worst_begin(void)
{
    calls = 0;
    missed = 0;
    for (int j = 0; j < 6; ++j) {
        held[j] = 0.0;
    }
}

/* How old the state is that is seen now, in calls. */
static int age(const double plant[20])
{
    return lesser((int)plant[LATENCY], calls);
}

/* What is seen at a call, with errors at which that looks safest. */
void worst_sense(const double plant[20], const double x[16], double corner[19], double seen[16])
{
    for (int i = 0; i < ERRORS; ++i) {
        corner[i] = (slope_along(x, held, i) > 0.0) ? 1.0 : 0.0;
    }
    sensed(x, corner, history[calls % (PAST + 1)]);
    copy(seen, history[(calls - age(plant)) % (PAST + 1)], 16);
}

/* The controls that have been held since that was measured, the oldest first; `count`: how many. */
const double *worst_sent(const double plant[20], int *count)
{
    static double sent[6 * (PAST + 1)];
    *count = age(plant);
    for (int i = 0; i < *count; ++i) {
        copy(&sent[6 * i], past[(calls - *count + i) % (PAST + 1)], 6);
    }
    return sent;
}

/* From what a call wants to what is held, the last control where missing the call does more harm, and to what acts. */
void worst_hold(const double plant[20], const double x[16], double control[6], double corner[19], double acting[6])
{
    const int can_miss = (calls > 0) && (missed < MISSED_MOST);
    const int is_missed = can_miss && (margin_after(x, held) < margin_after(x, control));
    if (is_missed) {
        copy(control, held, 6);
    }
    missed = is_missed ? (missed + 1) : 0;
    copy(held, control, 6);
    copy(past[calls % (PAST + 1)], control, 6);
    calls += 1;
    corner[MISSED] = is_missed ? 1.0 : 0.0;
    for (int j = 0; j < GAINS; ++j) {
        corner[ERRORS + j] = ((slope_along(x, held, ERRORS + j) * held[j]) < 0.0) ? 1.0 : 0.0;
    }
    actuated(&plant[THRUST], &plant[TORQUE], &corner[ERRORS], control, acting);
}

void worst_move(const double plant[20], double x[16], const double acting[6])
{
    double y[16];
    moved(x, acting, &plant[BODY], y);
    copy(x, y, 16);
}
