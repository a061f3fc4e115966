/* From rows to programs, and from their solutions to what is reported. */

enum { THRUST = 0, TORQUE = 1 }; /* a group of three actuators, controls 3 group, ... */

/* The rows a u + b >= 0 of a group in N or N m, as the printed functions compute them. */
struct rows {
    double psi[GROUP_ROWS_MAX];
    double a[GROUP_ROWS_MAX * 3];
    double b[GROUP_ROWS_MAX];
    double b_bare[GROUP_ROWS_MAX]; /* without margin */
    double waived[GROUP_ROWS_MAX]; /* by how much that asks for less than the condition does, beyond a limit */
    double h[GROUP_CONSTRAINTS_MAX];
    double tightening[GROUP_ROWS_MAX];  /* by how much b is less for what the filter does not know */
    double length[GROUP_ROWS_MAX]; /* per actuator limit */
    double lowest[1];              /* scaled left-hand side at the control; negative or NaN: to be corrected */
};

/* The same in units of the actuators' limits, of unit length. */
struct scaled {
    double a[GROUP_ROWS_MAX][3];
    double b[GROUP_ROWS_MAX];
    double b_bare[GROUP_ROWS_MAX];
    double waived[GROUP_ROWS_MAX]; /* not scaled, as length */
    double length[GROUP_ROWS_MAX];
};

/* A control of one group, and what its rows say of it. */
struct found {
    double control[3]; /* in units of the actuators' limits */
    int status;
    double residual;
    int active[GROUP_CONSTRAINTS_MAX];
    double slack[GROUP_CONSTRAINTS_MAX];
};

/* `limit`: what is there of each actuator, in N or N m. */
static void scale(int group, const struct rows *rows, const double limit[3], struct scaled *scaled)
{
    for (int i = 0; i < ROWS[group]; ++i) {
        const double length = rows->length[i];
        scaled->b[i] = clip(rows->b[i] / length, HOPELESS, REDUNDANT);
        scaled->b_bare[i] = clip(rows->b_bare[i] / length, HOPELESS, REDUNDANT);
        scaled->waived[i] = rows->waived[i];
        scaled->length[i] = length;
        for (int j = 0; j < 3; ++j) {
            scaled->a[i][j] = rows->a[(3 * i) + j] * (limit[j] / length);
        }
    }
}

/* More rows of a program, each of which asks for so much more than it must (`inset`) and counts as so many. */
static void append(struct program *p, int group, const struct scaled *scaled, const double inset[GROUP_ROWS_MAX],
                   int copies)
{
    for (int i = 0; i < ROWS[group]; ++i) {
        copy(p->a[p->rows], scaled->a[i], 3);
        p->b[p->rows] = scaled->b[i] - inset[i];
        p->b_bare[p->rows] = scaled->b_bare[i] - inset[i];
        p->weight[p->rows] = WEIGHT[group][i];
        p->copies[p->rows] = (double)copies;
        p->rows += 1;
    }
}

/* Says by constraint whether a row binds the control found, and how far one falls short: where rows yielded, and where
 * a row beyond its limit asks for less than the condition does. */
static void say(int group, const struct scaled *scaled, struct found *found)
{
    double reached[GROUP_ROWS_MAX];
    double least = INFINITY;
    for (int k = 0; k < GROUP_CONSTRAINTS_MAX; ++k) {
        found->active[k] = 0;
        found->slack[k] = 0.0;
    }
    for (int i = 0; i < ROWS[group]; ++i) {
        reached[i] = dot(scaled->a[i], found->control, 3);
        least = smaller(least, reached[i] + scaled->b[i]);
    }
    const double *side = (least >= -FEASIBLE) ? scaled->b : scaled->b_bare;
    for (int i = 0; i < ROWS[group]; ++i) {
        const int k = CONSTRAINT_OF_ROW[group][i];
        const double lack = -(reached[i] + scaled->b_bare[i]) * scaled->length[i];
        if ((reached[i] + side[i]) <= FEASIBLE) {
            found->active[k] = 1;
        }
        if (found->status >= SLACK) {
            found->slack[k] = larger(found->slack[k], lack);
        }
        if ((scaled->waived[i] > 0.0) && ((lack + scaled->waived[i]) > (FEASIBLE * scaled->length[i]))) {
            found->slack[k] = larger(found->slack[k], lack + scaled->waived[i]);
        }
    }
}

/* What rows lack is reported; then the status is SLACK at least. */
static void report_slack(int group, const struct found *found, struct safety_filter_output *out)
{
    for (int k = 0; k < CONSTRAINTS_OF[group]; ++k) {
        out->slack[PLACE[group][k]] = found->slack[k];
        if ((found->slack[k] > 0.0) && (out->program_status[group] < SLACK)) {
            out->program_status[group] = SLACK;
        }
    }
}

/* A control that satisfies the rows is applied as it is; what they waive is reported. `limit`: as in `scale`. */
static void leave_as_is(int group, const struct rows *rows, const double limit[3], const double control[6],
                        struct safety_filter_output *out)
{
    struct scaled scaled;
    struct found found;
    scale(group, rows, limit, &scaled);
    for (int j = 0; j < 3; ++j) {
        found.control[j] = control[(3 * group) + j] / LIMIT[group];
    }
    found.status = out->program_status[group];
    say(group, &scaled, &found);
    report_slack(group, &found, out);
}

/* What was found becomes the control, and is reported. */
static void apply(int group, const struct found *found, double control[6], struct safety_filter_output *out)
{
    for (int j = 0; j < 3; ++j) {
        control[(3 * group) + j] = found->control[j] * LIMIT[group];
    }
    out->program_status[group] = found->status;
    out->residual[group] = found->residual;
    for (int k = 0; k < CONSTRAINTS_OF[group]; ++k) {
        out->active[PLACE[group][k]] = found->active[k];
    }
    report_slack(group, found, out);
}

/* What is projected of a group's desired control: any size up to LARGEST_DEMAND limits, zero where a number is none. */
static void wish_of(int group, const double desired[3], double wish[3])
{
    double most = LARGEST_DEMAND; /* in units of the actuators' limits */
    int is_none = 0;
    for (int j = 0; j < 3; ++j) {
        wish[j] = clip(desired[j], -ENDLESS, ENDLESS);
        is_none = (isnan(desired[j]) != 0) ? 1 : is_none;
        most = fmax(most, fabs(wish[j]) / LIMIT[group]);
    }
    for (int j = 0; j < 3; ++j) {
        wish[j] = (is_none != 0) ? 0.0 : (wish[j] * (LARGEST_DEMAND / most));
    }
}

/* The state, NaN where it is infinite: infinitely safe is no state either. What is projected of the desired control,
 * and that clipped to the limits. A result that says of every constraint that there is nothing to say. */
static void begin(const struct safety_filter_input *in, double x[16], double wish[6], double control[6],
                  struct safety_filter_output *out)
{
    for (int i = 0; i < 16; ++i) {
        x[i] = isinf(in->state[i]) ? NAN : in->state[i];
    }
    for (int k = 0; k < CONSTRAINTS; ++k) {
        out->h[k] = 0.0;
        out->slack[k] = 0.0;
        out->active[k] = 0;
        out->uncertainty[k] = 0.0;
        out->tightened[k] = 0.0;
    }
    out->verified = 0;
    out->backup = 0;
    for (int group = THRUST; group <= TORQUE; ++group) {
        out->program_status[group] = UNTOUCHED;
        out->residual[group] = 0.0;
        wish_of(group, &in->desired[3 * group], &wish[3 * group]);
        for (int j = 3 * group; j < (3 * (group + 1)); ++j) {
            control[j] = clip(wish[j], -LIMIT[group], LIMIT[group]);
            if (!((in->desired[j] >= -LIMIT[group]) && (in->desired[j] <= LIMIT[group]))) {
                out->program_status[group] = HARD;
            }
        }
    }
}

/* The control and the worse status. Nothing is verified of a state that is older than what the filter was told. */
static void end(const struct safety_filter_input *in, const double control[6], struct safety_filter_output *out)
{
    if (in->sent_count > LATENCY) {
        out->program_status[THRUST] = UNSOLVED;
        out->program_status[TORQUE] = UNSOLVED;
        out->verified = 0;
    }
    const int thrust = out->program_status[THRUST];
    const int torque = out->program_status[TORQUE];
    copy(out->control, control, 6);
    out->status = (thrust > torque) ? thrust : torque;
    out->violated = 0;
    for (int k = 0; k < CONSTRAINTS; ++k) {
        out->violated = (out->h[k] < 0.0) ? 1 : out->violated;
    }
}
