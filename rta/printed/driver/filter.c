/* The order of a call: torque first, since the attitude decides where thrust acts. */

/* What is projected of a group's desired control: any size up to LARGEST_DEMAND limits, zero where a number is none. */
static void projected_of(int group, const double desired[3], double projected[3])
{
    double most = LARGEST_DEMAND; /* in units of the actuators' limits */
    int is_none = 0;
    for (int j = 0; j < 3; ++j) {
        projected[j] = clip(desired[j], -ENDLESS, ENDLESS);
        is_none = (isnan(desired[j]) != 0) ? 1 : is_none;
        most = fmax(most, fabs(projected[j]) / LIMIT[group]);
    }
    for (int j = 0; j < 3; ++j) {
        projected[j] = (is_none != 0) ? 0.0 : (projected[j] * (LARGEST_DEMAND / most));
    }
}

/* The state, NaN where it is infinite: infinitely safe is no state either. What is projected of the desired control,
 * and that clipped to the limits. A result that says of every constraint that there is nothing to say. */
static void begin(const struct safety_filter_input *in, double x[16], double projected[6], double control[6],
                  struct safety_filter_output *out)
{
    for (int i = 0; i < 16; ++i) {
        x[i] = isinf(in->state[i]) ? NAN : in->state[i];
    }
    for (int k = 0; k < CONSTRAINTS; ++k) {
        out->h[k] = 0.0;
        out->slack[k] = 0.0;
        out->active[k] = 0;
    }
    out->verified = 0;
    out->backup = 0;
    for (int group = THRUST; group <= TORQUE; ++group) {
        out->program_status[group] = UNTOUCHED;
        out->residual[group] = 0.0;
        projected_of(group, &in->desired[3 * group], &projected[3 * group]);
        for (int j = 3 * group; j < (3 * (group + 1)); ++j) {
            control[j] = clip(projected[j], -LIMIT[group], LIMIT[group]);
            if (!((in->desired[j] >= -LIMIT[group]) && (in->desired[j] <= LIMIT[group]))) {
                out->program_status[group] = HARD;
            }
        }
    }
}

/* The control and the worse status. Nothing is verified of a state that is older than LATENCY. */
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

/* The state now, from one that is as old as the controls sent since. */
static void bring_up_to_date(const struct safety_filter_input *in, const double left[6], double x[16],
                             double error_bound[4])
{
#if LATENCY > 0
    for (int k = 0; (k < LATENCY) && (k < in->sent_count); ++k) {
        double u[6];
        double x_after[16];
        double error_bound_after[4];
        for (int j = 0; j < 6; ++j) {
            u[j] = left[j] * in->sent[k][j];
        }
        predict(x, error_bound, u, x_after, error_bound_after);
        copy(x, x_after, 16);
        copy(error_bound, error_bound_after, 4);
    }
#else
    (void)in;
    (void)left;
    (void)x;
    (void)error_bound;
#endif
}

/* Replaces what the thrusters do not give, and torque that would leave a dead axis on the radius: that is projected. */
static void replace_desired(const double x[16], const double left[6], double projected[6], double control[6],
                            struct safety_filter_output *out)
{
    double asked[6];
    copy(asked, control, 6);
    round_thrust(control);
#if HEALTH
    turn_in_time(x, &asked[3], left, &control[3]);
#else
    (void)x;
    (void)left;
#endif
    for (int j = 0; j < 6; ++j) {
        if (!((control[j] <= asked[j]) && (control[j] >= asked[j]))) {
            const int first = 3 * (j / 3);
            out->program_status[j / 3] = HARD;
            copy(&projected[first], &control[first], 3);
        }
    }
}

#if PROGRAMS
/* The rows of a group; `left`: the share that each actuator gives. */
static void rows_of(int group, const double x[16], const double control[6], const double left[6], struct rows *r)
{
#if HEALTH
#define LEFT left,
#else
#define LEFT
    (void)left;
#endif
    if (group == THRUST) {
        thrust_rows(x, control, LEFT r->psi, r->a, r->b, r->b_no_margin, r->relaxation, r->h, r->length, r->lowest);
    } else {
        torque_rows(x, control, LEFT r->psi, r->a, r->b, r->b_no_margin, r->relaxation, r->h, r->length, r->lowest);
    }
}

/* A group's controls: as desired where these satisfy its rows, else what its program answers. */
static void propose(int group, const double x[16], const double left[6], const double projected[6], double control[6],
                    struct safety_filter_output *out)
{
    const int first = 3 * group;
    double limit[3];
    double u[3]; /* in units of the limits */
    struct rows rows;
    struct scaled scaled;
    rows_of(group, x, control, left, &rows);
    for (int k = 0; k < CONSTRAINTS_OF[group]; ++k) {
        out->h[PLACE[group][k]] = rows.h[k];
    }
    for (int j = 0; j < 3; ++j) {
        limit[j] = LIMIT[group] * left[first + j];
    }
    scale(group, &rows, limit, &scaled);
    const int is_corrected = (rows.lowest[0] >= 0.0) ? 0 : 1; /* NaN must not pass */
    for (int j = 0; j < 3; ++j) {
        u[j] = ((is_corrected != 0) ? projected[first + j] : control[first + j]) / LIMIT[group];
    }
    if (is_corrected != 0) {
        struct program program;
        struct answer answer;
        program_of(group, &scaled, u, &program);
        solve(&program, &answer);
        out->program_status[group] = answer.status;
        out->residual[group] = answer.residual;
        for (int j = 0; j < 3; ++j) {
            u[j] = answer.control[j];
            control[first + j] = u[j] * LIMIT[group];
        }
    }
    say(group, &scaled, u, is_corrected, out);
    if (group == THRUST) {
        round_thrust(control);
    }
}
#else
/* Without rows: the desired control goes to the check as it is; in a state that is none nothing is done. */
static void propose(int group, const double x[16], const double left[6], const double projected[6], double control[6],
                    struct safety_filter_output *out)
{
    double h[CONSTRAINTS];
    (void)left;
    (void)projected;
    values(x, h);
    for (int k = 0; k < CONSTRAINTS_OF[group]; ++k) {
        out->h[PLACE[group][k]] = h[PLACE[group][k]];
    }
    for (int i = 0; i < 16; ++i) {
        if (isfinite(x[i]) == 0) {
            const double nothing[3] = {0.0, 0.0, 0.0};
            copy(&control[3 * group], nothing, 3);
            out->program_status[group] = UNSOLVED;
        }
    }
}
#endif

void safety_filter(const struct safety_filter_input *in, struct safety_filter_output *out)
{
    double x[16];
    double error_bound[4] = {0.0, 0.0, 0.0, 0.0};
    double left[6];
    double projected[6];
    double control[6];
    begin(in, x, projected, control, out);
    for (int j = 0; j < 6; ++j) {
        left[j] = (HEALTH != 0) ? in->left[j] : 1.0;
    }
    bring_up_to_date(in, left, x, error_bound);
    replace_desired(x, left, projected, control, out);
    propose(TORQUE, x, left, projected, control, out);
    propose(THRUST, x, left, projected, control, out); /* with the torque that is found */
#if CHECKED
    check_control(x, error_bound, control, out);
#endif
    end(in, control, out);
}
