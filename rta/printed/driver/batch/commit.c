/* Lanes whose controls are not seen at a glance to keep all limits and to leave a way to rest, whose rates are beyond
 * theirs, or in which a limit of the user's own yields. Numbers: controls, slack, h. Not among them, but in
 * `thrust_alone`, are lanes in which nothing but thrust is to be looked at closely. */
static M unsure(const V x[16], const V numbers[6 + 2 * CONSTRAINTS], M *thrust_alone)
{
    M found = NO;
    *thrust_alone = NO;
#if BACKUP
    V thrust[1];
    V torque[1];
    thrust_glance(x, numbers, thrust);
    torque_sight(x, numbers, torque);
    if (any(~(torque[0] >= 0.0))) {
        torque_glance(x, numbers, torque);
    }
    for (int k = MOTION_LIMITS + ATTITUDE_LIMITS; k < KEPT_LIMITS; ++k) {
        found |= ~(numbers[6 + CONSTRAINTS + k] >= -RATES_ROUNDED);
    }
    for (int k = KEPT_LIMITS; k < CONSTRAINTS; ++k) {
        found |= numbers[6 + k] > 0.0;
    }
    found |= ~(torque[0] >= 0.0);
    *thrust_alone = ~(found | (thrust[0] >= 0.0));
    found |= ~(thrust[0] >= 0.0);
    for (int k = 0; k < MOTION_LIMITS; ++k) {
        *thrust_alone &= numbers[6 + CONSTRAINTS + k] >= 0.0; /* there is no way from beyond a limit */
    }
    found &= ~*thrust_alone;
#else
    (void)x;
    (void)numbers;
#endif
    return found;
}

/* Where controls are safe no limit yields: what its rows lacked was the rows' alone. */
static void nothing_yields(M unseen, V program_status[2], V slack[CONSTRAINTS])
{
#if BACKUP
    for (int group = 0; group < 2; ++group) {
        program_status[group] = SELECT(unseen, program_status[group], MIN(program_status[group], ALL(1.0)));
    }
    for (int k = 0; k < CONSTRAINTS; ++k) {
        slack[k] = SELECT(unseen, slack[k], ALL(0.0));
    }
#else
    (void)unseen;
    (void)program_status;
    (void)slack;
#endif
}

/* Spacecraft whose thrust is to be looked at closely. A look at W of them takes as long as at one, so that they wait
 * until there are W. */
struct waiting {
    V x[16];
    V control[6];
    long column[W];
    int count;
};

#if BACKUP
/* Lanes in which thrust keeps the limits of motion while it is held and leaves a way to rest: `thrust_is_safe` of commit.c
 * for one spacecraft. */
static M are_safe(const V x[16], const V control[6])
{
    V y[16];
    V later[16];
    V at[10];
    V after[10];
    V least[1];
    M flying = YES;
    M safe = NO;
    memcpy(y, x, sizeof y);
    for (int i = 0; (i < LOOKS) && any(flying); ++i) {
        thrust_look(y, control, later, least);
        flying &= least[0] >= 0.0;
        memcpy(y, later, sizeof y);
    }
    beginning(y, at);
    for (int k = 0; (k < BRAKING_HOLDS) && any(flying); ++k) {
        const M is_at_rest = SQRT((at[3] * at[3]) + (at[4] * at[4]) + (at[5] * at[5])) <= AT_REST;
        braked(at, after, least);
        flying &= least[0] >= 0.0;
        safe |= flying & is_at_rest;
        flying &= ~is_at_rest;
        memcpy(at, after, sizeof at);
    }
    return safe;
}
#endif

/* Looks closely at those that wait. What is stored of them says that they are safe; who is not goes to the filter for one
 * spacecraft, which stores all of it anew. Returns how many of these have no solution. */
static long look_closely(struct waiting *these, const void *const *in, const long *in_step, void *const *out,
                         const long *out_step)
{
    long unsolved = 0;
#if BACKUP
    for (int i = 0; i < 16 + 6; ++i) {
        V *const part = (i < 16) ? &these->x[i] : &these->control[i - 16];
        for (int lane = these->count; lane < W; ++lane) {
            (*part)[lane] = (*part)[0];
        }
    }
    const M safe = (these->count > 0) ? are_safe(these->x, these->control) : NO;
    for (int lane = 0; lane < these->count; ++lane) {
        if (!safe[lane]) {
            unsolved += filter_one(these->column[lane], in, in_step, out, out_step);
        }
    }
    these->count = 0;
#else
    (void)these;
    (void)in;
    (void)in_step;
    (void)out;
    (void)out_step;
#endif
    return unsolved;
}

/* Has a lane wait, and looks at all that wait when there are W. */
static long wait_for_a_look(struct waiting *these, const V x[16], const V control[6], int lane, long column,
                            const void *const *in, const long *in_step, void *const *out, const long *out_step)
{
    for (int i = 0; i < 16; ++i) {
        these->x[i][these->count] = x[i][lane];
    }
    for (int j = 0; j < 6; ++j) {
        these->control[j][these->count] = control[j][lane];
    }
    these->column[these->count] = column;
    these->count += 1;
    return (these->count == W) ? look_closely(these, in, in_step, out, out_step) : 0;
}

/* Has the filter for one spacecraft filter the lanes that are open. */
static long finish(M open, M thrust_alone, struct waiting *these, const V x[16], const V control[6], long column, long lanes,
                   const void *const *in, const long *in_step, void *const *out, const long *out_step)
{
    long unsolved = 0;
    for (int lane = 0; lane < W && lane < lanes; ++lane) {
        if (open[lane]) {
            unsolved += filter_one(column + lane, in, in_step, out, out_step);
        } else if (thrust_alone[lane]) {
            unsolved += wait_for_a_look(these, x, control, lane, column + lane, in, in_step, out, out_step);
        }
    }
    return unsolved;
}
