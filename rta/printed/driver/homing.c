/* Propose, check, commit, of thrust alone: it is applied if from every state that may be true the limits of motion are kept
 * while it is held, however long within the bounds, and a way into the haven begins then; else the nearest that is, on the
 * way to the law's. */

static double apart(const double first[3], const double last[3])
{
    double sum = 0.0;
    for (int i = 0; i < 3; ++i) {
        sum += (first[i] - last[i]) * (first[i] - last[i]);
    }
    return sqrt(sum);
}

/* Where a hold may end, call by call. */
struct hold_ends {
    double x[HELD_CALLS][16];
    double error_bound[HELD_CALLS][4];
    double late[HELD_CALLS];
};

/* Whether a way begins wherever a hold may end, by one look. */
static int home_at_a_glance(const struct hold_ends *ends)
{
    const double *middle = ends->x[(HELD_CALLS - 1) / 2];
    double widest[4] = {0.0, 0.0, 0.0, 0.0};
    double late[1] = {0.0};
    double least[1];
    for (int call = 0; call < HELD_CALLS; ++call) {
        const double *bound = ends->error_bound[call];
        widest[0] = larger(widest[0], bound[0] + apart(ends->x[call], middle));
        widest[1] = larger(widest[1], bound[1] + apart(&ends->x[call][3], &middle[3]));
        widest[2] = larger(widest[2], bound[2]);
        widest[3] = larger(widest[3], bound[3]);
        late[0] = larger(late[0], ends->late[call]);
    }
    homing_way(middle, widest, late, least);
    return (least[0] >= 0.0) ? 1 : 0;
}

static int homes(const double x[16], const double error_bound[4], const double control[6])
{
    struct hold_ends ends;
    double now[16];
    double bound[4];
    double grown[HELD_CALLS + 1];
    double least[1];
    int found = 1;
    copy(now, x, 16);
    copy(bound, error_bound, 4);
    grown[0] = bound[1];
    for (int call = 0; (call < HELD_CALLS) && (found != 0); ++call) {
        homing_look(now, control, bound, ends.x[call], ends.error_bound[call], least);
        found = (least[0] >= 0.0) ? 1 : 0;
        copy(now, ends.x[call], 16);
        copy(bound, ends.error_bound[call], 4);
        grown[call + 1] = bound[1];
        ends.late[call] = (call + 1 >= LATENCY) ? (bound[1] - grown[call + 1 - LATENCY]) : bound[1];
    }
    if ((found != 0) && (home_at_a_glance(&ends) == 0)) {
        for (int call = 0; (call < HELD_CALLS) && (found != 0); ++call) {
            homing_way(ends.x[call], ends.error_bound[call], &ends.late[call], least);
            found = (least[0] >= 0.0) ? 1 : 0;
        }
    }
    return found;
}

/* The nearest thrust that is safe on the way to the law's; returns 0 if not even that is seen to be. */
static int home_to_law(const double x[16], const double error_bound[4], double control[6])
{
    static const double shares[SHARE_COUNT] = SHARES;
    double proposed[3];
    double law[3];
    int found = 0;
    copy(proposed, control, 3);
    homing_law(x, control, law);
    for (int i = 0; (i < SHARE_COUNT) && (found == 0); ++i) {
        for (int j = 0; j < 3; ++j) {
            const double tried = proposed[j] + (shares[i] * (law[j] - proposed[j]));
            control[j] = clip(tried, smaller(proposed[j], law[j]), larger(proposed[j], law[j]));
        }
        round_thrust(control);
        found = homes(x, error_bound, control);
    }
    return found;
}

/* The limits of motion are kept: what their rows lacked was the rows' alone. */
static void nothing_of_thrust_yields(struct safety_filter_output *out)
{
    double left = 0.0;
    for (int k = 0; k < CONSTRAINTS_OF[THRUST]; ++k) {
        const int place = PLACE[THRUST][k];
        if (IS_KEPT[place] != 0) {
            out->slack[place] = 0.0;
        }
        left = larger(left, out->slack[place]);
    }
    if ((out->program_status[THRUST] == SLACK) && !(left > SLACK_ROUNDED)) {
        out->program_status[THRUST] = HARD;
    }
}

/* Returns whether the thrust that is applied is verified. */
static int commit_thrust(const double x[16], const double error_bound[4], double control[6],
                         struct safety_filter_output *out)
{
    double least[1];
    int verified = 1;
    homing_kept(x, error_bound, least);
    for (int i = 0; i < 16; ++i) {
        verified &= (isfinite(x[i]) != 0) ? 1 : 0;
    }
    for (int i = 0; i < 4; ++i) {
        verified &= (isfinite(error_bound[i]) != 0) ? 1 : 0;
    }
    if ((verified != 0) && (least[0] >= 0.0)) {
        verified = homes(x, error_bound, control);
        if (verified == 0) {
            verified = home_to_law(x, error_bound, control);
            out->backup = 1;
            if (out->program_status[THRUST] < HARD) {
                out->program_status[THRUST] = HARD;
            }
        }
        if (verified != 0) {
            nothing_of_thrust_yields(out);
        }
    } else {
        verified = 0;
    }
    return verified;
}
