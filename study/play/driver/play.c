/* A flight for a page: the state, the filters by index, and the model. All numbers that go in or out are of double
 * precision, in arrays whose places `at` tells in the order of `enum part`; see flight.js. */

enum part { STATE, DESIRED, CONTROL, PRIORITY, VALUES, ACTIVE, WEIGHTS, LIT, INSPECTED, AHEAD, WAY, ANSWER, FAILED, SCORE };

#define EXPORT(name) __attribute__((export_name(#name)))

static double state[16];
static double desired[6];
static double control[6];
static double priority[3];
static double values[SAFETY_FILTER_CONSTRAINTS];
static double active[SAFETY_FILTER_CONSTRAINTS];
static double weights[POINTS];
static double lit[POINTS];
static double seen[POINTS];
static double inspected[POINTS];
static double ahead[3 * AHEAD_MOST];
static double way[3 * AHEAD_MOST];
static double answer[3]; /* status, verified, backup */
static double failed[3]; /* crash, out of bounds, out of power */
static double score[1];

EXPORT(at) double *at(int part)
{
    double *const parts[] = {state, desired, control, priority, values, active, weights, lit, inspected, ahead, way,
                             answer, failed, score};
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
    in_view(state, lit, seen);
    score[0] = 0.0;
    for (int i = 0; i < POINTS; ++i) {
        inspected[i] = ((inspected[i] > 0.0) || (seen[i] > 0.0)) ? 1.0 : 0.0;
        score[0] += inspected[i] * weights[i];
    }
#if AGENT
    agent_look(state, lit, inspected);
#endif
}

/* Starts from `state` and `priority`; points in view count as inspected. */
EXPORT(begin) void begin_flight(void)
{
    for (int i = 0; i < POINTS; ++i) {
        inspected[i] = 0.0;
    }
    point_weights(priority, weights);
#if AGENT
    agent_begin();
#endif
    look();
    judge();
}

/* From `desired` to `control`, by a filter or as it is. */
EXPORT(ask) void ask(int filter, int is_on)
{
    struct safety_filter_input in = {.left = {1.0, 1.0, 1.0, 1.0, 1.0, 1.0}};
    struct safety_filter_output out;
    for (int k = 0; k < 16; ++k) {
        in.state[k] = state[k];
    }
    for (int j = 0; j < 6; ++j) {
        control[j] = in.desired[j] = desired[j];
    }
    for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
        active[k] = 0.0;
    }
    answer[0] = answer[1] = answer[2] = 0.0;
    if (is_on != 0) {
        corrects[filter](&in, &out);
        for (int j = 0; j < 6; ++j) {
            control[j] = out.control[j];
        }
        for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
            active[k] = out.active[k];
        }
        answer[0] = out.status;
        answer[1] = out.verified;
        answer[2] = out.backup;
    }
}

/* A step of the model under `control`. */
EXPORT(fly) void fly(void)
{
    double y[16];
    model_step(state, control, y);
    for (int k = 0; k < 16; ++k) {
        state[k] = y[k];
    }
    judge();
}

/* Torque that points the camera at the chief, into `desired`. */
EXPORT(assist) void assist(int filter)
{
    assists[filter](state, &desired[3]);
}

/* The classical guidance's control, into `desired`. */
EXPORT(guide) void guide(int filter)
{
    guides[filter](state, score, desired);
}

/* The agent's decision, into `desired`; as it is where there is none. */
EXPORT(decide) void decide(void)
{
#if AGENT
    agent_decide(state, priority, score, desired);
#endif
}

/* Full control against the row that is nearest to be broken, into `desired`. */
EXPORT(attack) void attack(void)
{
    adversary(state, desired);
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
