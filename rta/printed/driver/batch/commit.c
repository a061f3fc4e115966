/* Spacecraft whose controls are to be looked at closely. A look at W of them takes as long as at one, so that they wait
 * until there are W. */
struct waiting {
    V y[SEEN];
    V desired[6];
    V control[6];
    V slack[CONSTRAINTS];
    V h[CONSTRAINTS];
    V program_status[2];
    long column[W];
    int count;
};

static void put_lane(V *to, int place, const V *from, int lane, int count)
{
    for (int i = 0; i < count; ++i) {
        to[i][place] = from[i][lane];
    }
}

static void put_waiting(struct waiting *to, int place, const struct waiting *from, int lane)
{
    put_lane(to->y, place, from->y, lane, SEEN);
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
    M fit[2];
    if (these->count == 0) {
        return;
    }
    for (int lane = these->count; lane < W; ++lane) {
        put_lane(these->y, lane, these->y, 0, SEEN);
        put_lane(these->control, lane, these->control, 0, 6);
        put_lane(these->h, lane, these->h, 0, CONSTRAINTS);
    }
    are_fit(these->y, these->h, broken, fit);
    commit(these->y, broken, fit, these->control, safe, changed);
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
