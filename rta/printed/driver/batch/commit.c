/* Spacecraft whose controls are to be looked at closely. A look at W of them takes as long as at one, so that they wait
 * until there are W. */
struct waiting {
    V x[16];
    V desired[6];
    V control[6];
    V slack[CONSTRAINTS];
    V h[CONSTRAINTS];
    V program_status[2];
    long column[W];
    int count;
};

#if BACKUP
/* Lanes whose controls are not seen at once to keep all limits and to begin a flight that does; where they are nothing
 * yields. Numbers: controls, slack, h. */
static M are_unsure(const V x[16], V numbers[6 + 2 * CONSTRAINTS], V program_status[2])
{
    const M unchanged[2] = {NO, NO};
    V after[16];
    V least[LIMITS];
    M broken[LIMITS];
    M kept[2];
    M later[2];
    are_broken(&numbers[6 + CONSTRAINTS], broken);
    flown(x, numbers, after, least);
    are_kept(least, broken, kept);
    at_once(after, least);
    are_kept(least, broken, later);
    const M both = kept[0] & later[0] & kept[1] & later[1];
    const M safe[2] = {both, both};
    const M sure = is_verified(broken, safe);
    const M seen[2] = {sure, sure};
    nothing_yields(broken, seen, unchanged, &numbers[6], program_status);
    return ~sure;
}

static void put_lane(V *to, int place, const V *from, int lane, int count)
{
    for (int i = 0; i < count; ++i) {
        to[i][place] = from[i][lane];
    }
}

/* Checks those that wait, and stores what is applied. */
static void check_waiting(struct waiting *these, void *const *out, const long *out_step)
{
    M broken[LIMITS];
    M safe[2];
    M changed[2];
    M strange = NO;
    if (these->count == 0) {
        return;
    }
    for (int lane = these->count; lane < W; ++lane) {
        put_lane(these->x, lane, these->x, 0, 16);
        put_lane(these->control, lane, these->control, 0, 6);
        put_lane(these->h, lane, these->h, 0, CONSTRAINTS);
    }
    for (int i = 0; i < 16; ++i) {
        strange |= ~(FABS(these->x[i]) < INFINITY);
    }
    are_broken(these->h, broken);
    commit(these->x, broken, strange, these->control, safe, changed);
    nothing_yields(broken, safe, changed, these->slack, these->program_status);
    const M verified = is_verified(broken, safe);
    const M other = differ(these->desired, these->control);
    for (int lane = 0; lane < these->count; ++lane) {
        const long column = these->column[lane];
        double *const numbers = (double *)out[NUMBERS] + column;
        long *const statuses = (long *)out[STATUSES] + column;
        unsigned char *const truths = (unsigned char *)out[TRUTHS] + column;
        const double thrust = these->program_status[0][lane];
        const double torque = these->program_status[1][lane];
        for (int j = 0; j < 6; ++j) {
            numbers[j * out_step[NUMBERS]] = these->control[j][lane];
        }
        for (int k = 0; k < CONSTRAINTS; ++k) {
            numbers[(6 + k) * out_step[NUMBERS]] = these->slack[k][lane];
        }
        statuses[0] = (long)((thrust > torque) ? thrust : torque);
        statuses[out_step[STATUSES]] = (long)thrust;
        statuses[2 * out_step[STATUSES]] = (long)torque;
        truths[0] = other[lane] != 0;
        truths[out_step[TRUTHS]] = verified[lane] != 0;
        truths[2 * out_step[TRUTHS]] = (changed[0][lane] | changed[1][lane]) != 0;
    }
    these->count = 0;
}

/* Has a lane wait, and checks all that wait when there are W. */
static void wait_for_a_check(struct waiting *these, const V x[16], const V desired[6], const V numbers[6 + 2 * CONSTRAINTS],
                             const V program_status[2], int lane, long column, void *const *out, const long *out_step)
{
    const int place = these->count;
    put_lane(these->x, place, x, lane, 16);
    put_lane(these->desired, place, desired, lane, 6);
    put_lane(these->control, place, numbers, lane, 6);
    put_lane(these->slack, place, &numbers[6], lane, CONSTRAINTS);
    put_lane(these->h, place, &numbers[6 + CONSTRAINTS], lane, CONSTRAINTS);
    put_lane(these->program_status, place, program_status, lane, 2);
    these->column[place] = column;
    these->count += 1;
    if (these->count == W) {
        check_waiting(these, out, out_step);
    }
}
#endif

/* Has lanes that are left open filtered one by one, and those whose controls are not seen to be safe wait. */
static long finish(M open, M unsure, struct waiting *these, const V x[16], const V desired[6],
                   const V numbers[6 + 2 * CONSTRAINTS], const V program_status[2], long column, long lanes,
                   const void *const *in, const long *in_step, void *const *out, const long *out_step)
{
    long unsolved = 0;
    for (int lane = 0; lane < W && lane < lanes; ++lane) {
        if (open[lane]) {
            unsolved += filter_one(column + lane, in, in_step, out, out_step);
        } else if (unsure[lane]) {
#if BACKUP
            wait_for_a_check(these, x, desired, numbers, program_status, lane, column + lane, out, out_step);
#else
            (void)these;
            (void)x;
            (void)desired;
            (void)numbers;
            (void)program_status;
#endif
        }
    }
    return unsolved;
}
