#if BACKUP
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

/* Controls that keep all limits while they are held, and the flights that follow. */
struct hopeful {
    struct flights flights;
    struct waiting these;
};

/* Lanes whose controls are not seen at once to keep all limits and to begin a flight that does; where they are nothing
 * yields. Numbers: controls, slack, h. After: the states at the end of the hold; hopes: lanes in which that is kept. */
static M are_unsure(const V x[16], V numbers[6 + 2 * CONSTRAINTS], V program_status[2], V after[16], M *hopes)
{
    const M unchanged[2] = {NO, NO};
    V least[LIMITS];
    M broken[LIMITS];
    M kept[2];
    M later[2];
    are_broken(&numbers[6 + CONSTRAINTS], broken);
    flown(x, numbers, after, least);
    are_kept(least, broken, kept);
    const M both[2] = {kept[0] & kept[1], kept[0] & kept[1]};
    *hopes = is_verified(broken, both);
    at_once(after, least);
    are_kept(least, broken, later);
    const M sure = *hopes & later[0] & later[1];
    const M seen[2] = {sure, sure};
    nothing_yields(broken, seen, unchanged, &numbers[6], program_status);
    return ~sure;
}

static void put_waiting(struct waiting *to, int place, const struct waiting *from, int lane)
{
    put_lane(to->x, place, from->x, lane, 16);
    put_lane(to->desired, place, from->desired, lane, 6);
    put_lane(to->control, place, from->control, lane, 6);
    put_lane(to->slack, place, from->slack, lane, CONSTRAINTS);
    put_lane(to->h, place, from->h, lane, CONSTRAINTS);
    put_lane(to->program_status, place, from->program_status, lane, 2);
    to->column[place] = from->column[lane];
}

/* Stores what is applied of one that waits, and what is said of it. */
static void store_waiting(const struct waiting *these, int lane, int other, int verified, int backup, void *const *out,
                          const long *out_step)
{
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
    truths[0] = other != 0;
    truths[out_step[TRUTHS]] = verified != 0;
    truths[2 * out_step[TRUTHS]] = backup != 0;
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
        store_waiting(these, lane, other[lane] != 0, verified[lane] != 0, (changed[0][lane] | changed[1][lane]) != 0, out,
                      out_step);
    }
    these->count = 0;
}

/* Has a lane wait, and checks all that wait when there are W. */
static void wait_for_a_check(struct waiting *these, const struct waiting *from, int lane, void *const *out,
                             const long *out_step)
{
    put_waiting(these, these->count, from, lane);
    these->count += 1;
    if (these->count == W) {
        check_waiting(these, out, out_step);
    }
}

/* Flies on until there is room, or `all` flights have ended: stores controls whose flights keep all limits, and has the
 * others wait. */
static void fly_hopeful(struct hopeful *hopeful, int all, struct waiting *refused, void *const *out, const long *out_step)
{
    struct flights *const flights = &hopeful->flights;
    struct waiting *const these = &hopeful->these;
    while (flights->count == W || (all && flights->count > 0)) {
        const M unchanged[2] = {NO, NO};
        struct waiting kept = *these;
        fly_all(flights);
        const M other = differ(these->desired, these->control);
        nothing_yields(flights->broken, flights->found, unchanged, kept.slack, kept.program_status);
        for (int lane = flights->count - 1; lane >= 0; --lane) {
            if (has_ended(flights, lane)) {
                if (flights->found[0][lane] & flights->found[1][lane]) {
                    store_waiting(&kept, lane, other[lane] != 0, 1, 0, out, out_step);
                } else {
                    wait_for_a_check(refused, these, lane, out, out_step);
                }
                put_waiting(these, lane, these, flights->count - 1);
                end_flight(flights, lane);
            }
        }
    }
}
/* Of a block begins the flights of hopeful lanes, and has the other ones that are unsure wait. */
static void look_closely(M unsure, M hopes, const V after[16], struct waiting *block, struct hopeful *hopeful,
                         struct waiting *refused, long column, long lanes, void *const *out, const long *out_step)
{
    const M none[LIMITS] = {NO};
    const M both[2] = {YES, YES};
    for (int lane = 0; lane < W && lane < lanes; ++lane) {
        block->column[lane] = column + lane;
        if (unsure[lane] & hopes[lane]) {
            put_waiting(&hopeful->these, hopeful->flights.count, block, lane);
            begin_flight(&hopeful->flights, after, none, both, lane, column + lane);
            fly_hopeful(hopeful, 0, refused, out, out_step);
        } else if (unsure[lane]) {
            wait_for_a_check(refused, block, lane, out, out_step);
        }
    }
}
#endif
