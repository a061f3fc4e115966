/* Propose, check, commit, of thrust alone: it is applied if from every state that may be true the limits of motion are kept
 * while it is held, however long within the bounds, and a way into the haven begins then; else the nearest that is, on the
 * way to the law's. */

static int homes(const double x[16], const double error_bound[4], const double control[6])
{
    double now[16];
    double bound[4];
    double grown[HELD_CALLS + 1];
    double least[1];
    int found = 1;
    copy(now, x, 16);
    copy(bound, error_bound, 4);
    grown[0] = bound[1];
    for (int call = 0; (call < HELD_CALLS) && (found != 0); ++call) {
        double after[16];
        double bound_after[4];
        double late[1];
        homing_look(now, control, bound, after, bound_after, least);
        found = (least[0] >= 0.0) ? 1 : 0;
        copy(now, after, 16);
        copy(bound, bound_after, 4);
        grown[call + 1] = bound[1];
        late[0] = (call + 1 >= LATENCY) ? (bound[1] - grown[call + 1 - LATENCY]) : bound[1];
        if (found != 0) {
            homing_way(now, bound, late, least);
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
