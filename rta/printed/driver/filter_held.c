/* The filter where controls are held: torque first, since the body's turn decides where thrust will act. */

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
static void replace_desired(const double x[16], const double left[6], double wish[6], double control[6],
                            struct safety_filter_output *out)
{
    double asked[6];
    copy(asked, control, 6);
#if COARSE
    for (int j = 0; j < 3; ++j) {
        control[j] = given(control[j]);
    }
#endif
#if HEALTH
    turn_in_time(x, left, &control[3]);
#else
    (void)x;
    (void)left;
#endif
    for (int j = 0; j < 6; ++j) {
        if (!((control[j] <= asked[j]) && (control[j] >= asked[j]))) {
            const int first = 3 * (j / 3);
            out->program_status[j / 3] = HARD;
            copy(&wish[first], &control[first], 3);
        }
    }
}

/* A control with torque that keeps the rates within their limits over the hold, near which tangents help. Full torque
 * for 10 s would turn a body by 50 deg, of which no tangent says anything about less. Returns 1 if it is another. */
static int go_near(int group, const double x[16], const double control[6], double near_by[6])
{
    int is_other = 0;
    copy(near_by, control, 6);
    for (int j = 3; (j < 6) && (group == TORQUE); ++j) {
        const double rate = x[10 + j - 3];
        const double per_rate = INERTIA[j - 3] / HOLD;
        const double low = smaller(per_rate * (-RATE_LIMIT - rate), 0.0);
        const double high = larger(per_rate * (RATE_LIMIT - rate), 0.0);
        near_by[j] = larger(smaller(control[j], high), low);
    }
    for (int j = 0; j < 6; ++j) {
        if (!((near_by[j] <= control[j]) && (near_by[j] >= control[j]))) {
            is_other = 1;
        }
    }
    return is_other;
}

/* The barrier's value at which alpha is the tightening. With doubling d, y + y^3 = tightening / (gain d) for y = psi / d has the
 * root 2 / sqrt(3) sinh(asinh(..) / 3). */
static double tightened(int place, double tightening)
{
    const double d = DOUBLING[place];
    double psi = tightening / LAST_GAIN[place];
    if (isfinite(d) != 0) {
        psi = d * 2.0 / sqrt(3.0) * sinh(asinh(1.5 * sqrt(3.0) * psi / d) / 3.0);
    }
    psi = larger(psi, tightening / LARGEST_GAIN);
    return (FIRST_GAIN[place] > 0.0) ? (psi / FIRST_GAIN[place]) : psi; /* of relative degree two */
}

/* The constraints' values, and what the filter does not know of their conditions. */
static void report(int group, const struct rows *rows, struct safety_filter_output *out)
{
    double tightening[GROUP_CONSTRAINTS_MAX];
    for (int k = 0; k < GROUP_CONSTRAINTS_MAX; ++k) {
        tightening[k] = -INFINITY;
    }
    for (int i = 0; i < ROWS[group]; ++i) {
        const int k = CONSTRAINT_OF_ROW[group][i];
        tightening[k] = larger(tightening[k], rows->tightening[i]);
    }
    for (int k = 0; k < CONSTRAINTS_OF[group]; ++k) {
        const int place = PLACE[group][k];
        out->h[place] = rows->h[k];
        out->uncertainty[place] = tightening[k];
        out->tightened[place] = tightened(place, tightening[k]);
    }
}

/* Searches for another control, from rows at one near the desired one. */
static void correct(struct situation *where, const struct rows *rows, const double wish[6], double control[6],
                    struct safety_filter_output *out)
{
    struct scaled tangents;
    struct best best = {.score = -INFINITY};
    const int first = 3 * where->group;
    copy(where->control, control, 6);
    for (int j = 0; j < 3; ++j) {
        where->desired[j] = wish[first + j] / LIMIT[where->group];
    }
    where->size = fmax(1.0, fmax(fabs(where->desired[0]), fmax(fabs(where->desired[1]), fabs(where->desired[2]))));
    scale(where->group, rows, where->limit, &tangents);
    search(where, &tangents, &best);
#if COARSE
    if (where->group == THRUST) {
        settle_for_what_is_given(where, &best);
    }
#endif
    apply(where->group, &best.found, control, out);
}

static void filter_group(struct situation *where, const double wish[6], double control[6],
                         struct safety_filter_output *out)
{
    struct rows rows;
    double near_by[6];
    const int is_other = go_near(where->group, where->x, control, near_by);
    rows_of(where->group, where->x, near_by, where->error_bound, where->left, &rows);
    report(where->group, &rows, out);
    for (int j = 0; j < 3; ++j) {
        where->limit[j] = LIMIT[where->group] * where->left[(3 * where->group) + j];
    }
    if ((is_other != 0) || !(rows.lowest[0] >= 0.0)) { /* NaN must not pass */
        correct(where, &rows, wish, control, out);
    } else {
        leave_as_is(where->group, &rows, where->limit, control, out);
    }
}

void safety_filter(const struct safety_filter_input *in, struct safety_filter_output *out)
{
    struct situation where = {.group = TORQUE};
    double wish[6];
    double control[6];
    int verified[2] = {0, 0}; /* within bounds that are told */
    begin(in, where.x, wish, control, out);
    for (int j = 0; j < 6; ++j) {
        where.left[j] = (HEALTH != 0) ? in->left[j] : 1.0;
    }
    bring_up_to_date(in, where.left, where.x, where.error_bound);
    replace_desired(where.x, where.left, wish, control, out);
    for (int group = TORQUE; group >= THRUST; --group) {
        where.group = group;
        filter_group(&where, wish, control, out);
#ifdef TURN
        if (group == TORQUE) { /* before thrust, whose rows depend on what the body does */
            verified[TORQUE] = commit_turn(where.x, where.error_bound, control, out);
        }
#endif
#ifdef HELD_CALLS
        if (group == THRUST) {
            verified[THRUST] = commit_thrust(where.x, where.error_bound, control, out);
        }
#endif
    }
    out->verified = verified[THRUST] & verified[TORQUE];
#if BACKUP
    commit(where.x, control, out);
#endif
    end(in, control, out);
}
