/* A flight for a page: the state, the filters by index, and the model. All numbers that go in or out are of double
 * precision, in arrays whose places `at` tells in the order of `enum part`; see flight.js. */

enum part { STATE, DESIRED, CONTROL, PRIORITY, VALUES, ACTIVE, WEIGHTS, LIT, INSPECTED, AHEAD, WAY, ANSWER, FAILED, SCORE,
            SEEN, ACTING, PLANT, CORNER };

#define EXPORT(name) __attribute__((export_name(#name)))

static double state[16];
static double desired[6];
static double control[6];
static double priority[3];
static double values[LIMITS];
static double active[LIMITS];
static double weights[POINTS];
static double lit[POINTS];
static double in_sight[POINTS];
static double inspected[POINTS];
static double ahead[3 * AHEAD_MOST];
static double way[3 * AHEAD_MOST];
static double answer[3]; /* status, verified, backup */
static double failed[3]; /* crash, out of bounds, out of power */
static double score[1];
static double seen[16];   /* what the state is taken for */
static double acting[6];  /* where `control` is commanded */
static double plant[20];  /* of the flight, and */
static double corner[19]; /* where its errors are now: see worst.c */
static int is_worst;      /* whether there are any */
#if AGENT
static struct policy_clusters clusters; /* of points that are lit and left, and */
static double left[3];                  /* the direction of the nearest */
#endif

EXPORT(at) double *at(int part)
{
    double *const parts[] = {state, desired, control, priority, values, active, weights, lit, inspected, ahead, way,
                             answer, failed, score, seen, acting, plant, corner};
    return parts[part];
}

/* The constraints' values of now, and which ends have come. */
static void judge(void)
{
    constraint_values(state, values);
    failures(state, failed);
}

/* Marks the points in view. */
EXPORT(look) void look(void)
{
    in_view(state, lit, in_sight);
    score[0] = 0.0;
    for (int i = 0; i < POINTS; ++i) {
        inspected[i] = ((inspected[i] > 0.0) || (in_sight[i] > 0.0)) ? 1.0 : 0.0;
        score[0] += inspected[i] * weights[i];
    }
#if AGENT
    bool wanted[POINTS];
    for (int i = 0; i < POINTS; ++i) {
        wanted[i] = (lit[i] > 0.0) && !(inspected[i] > 0.0);
    }
    policy_look(&clusters, wanted, state, left);
#endif
}

/* Starts from `state` and `priority`, with the errors of `plant` at their worst or with none; points in view count as
 * inspected. */
EXPORT(begin) void begin_flight(int with_errors)
{
    is_worst = WORST && with_errors;
    for (int i = 0; i < POINTS; ++i) {
        inspected[i] = 0.0;
    }
    for (int i = 0; i < 19; ++i) {
        corner[i] = 0.0;
    }
    point_weights(priority, weights);
#if WORST
    worst_begin();
#endif
#if AGENT
    clusters = (struct policy_clusters){0};
#endif
    look();
    judge();
}

/* A call begins: what is `seen` of the state. */
EXPORT(sense) void sense(void)
{
    for (int k = 0; k < 16; ++k) {
        seen[k] = state[k];
    }
#if WORST
    if (is_worst != 0) {
        worst_sense(plant, state, corner, seen);
    }
#endif
}

/* It ends: from `desired` to `control`, by a filter or as it is, and to what acts. */
EXPORT(ask) void ask(int filter, int is_on)
{
    const double *sent = 0;
    int count = 0;
    for (int j = 0; j < 6; ++j) {
        control[j] = desired[j];
    }
    for (int k = 0; k < LIMITS; ++k) {
        active[k] = 0.0;
    }
    answer[0] = answer[1] = answer[2] = 0.0;
#if WORST
    if (is_worst != 0) {
        sent = worst_sent(plant, &count);
    }
#endif
    if (is_on != 0) {
        corrects[filter](seen, desired, sent, count, control, active, answer);
    }
    for (int j = 0; j < 6; ++j) {
        acting[j] = control[j];
    }
#if WORST
    if (is_worst != 0) {
        worst_hold(plant, state, control, corner, acting);
    }
#endif
}

/* A step of the motion under what acts. */
EXPORT(fly) void fly(void)
{
    double y[16];
#if WORST
    if (is_worst != 0) {
        worst_move(plant, state, acting);
        judge();
        return;
    }
#endif
    model_step(state, acting, y);
    for (int k = 0; k < 16; ++k) {
        state[k] = y[k];
    }
    judge();
}

/* Torque that points the camera at the chief, into `desired`. */
EXPORT(assist) void assist(int filter)
{
    assists[filter](seen, &desired[3]);
}

/* The classical guidance's control, into `desired`. */
EXPORT(guide) void guide(int filter)
{
    guides[filter](seen, score, desired);
}

/* The agent's decision, into `desired`; as it is where there is none. */
EXPORT(decide) void decide(void)
{
#if AGENT
    double observation[POLICY_OBSERVATIONS];
    policy_observe(seen, priority, left, score, 0, observation);
    (void)policy_control(observation, desired);
#endif
}

/* Full control against the row that is nearest to be broken, into `desired`. */
EXPORT(attack) void attack(void)
{
    adversary(seen, desired);
}

/* The way to rest behind `control`; returns how many places. */
EXPORT(rest) int rest(int filter)
{
    return ways[filter](state, control, way, AHEAD_MOST);
}

/* Where free flight leads, a place every so many steps. */
EXPORT(coast) void coast(int steps)
{
    static const double nothing[6] = {0.0};
    double x[16];
    double y[16];
    for (int k = 0; k < 16; ++k) {
        x[k] = state[k];
    }
    for (int i = 0; i < AHEAD_MOST; ++i) {
        for (int j = 0; j < 3; ++j) {
            ahead[(3 * i) + j] = x[j];
        }
        for (int s = 0; s < steps; ++s) {
            model_step(x, nothing, y);
            for (int k = 0; k < 16; ++k) {
                x[k] = y[k];
            }
        }
    }
}
