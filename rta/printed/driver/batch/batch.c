/* Attempts all programs, W spacecraft at a time, and has those that are left solved one by one. */

/* The states now, from those that are as old as the controls sent since. Returns lanes that are left to the
 * filter for one spacecraft: an actuator gives less there. */
static M bring_up_to_date(const void *const *in, const long *in_step, long column, long lanes, V x[SEEN], V error_bound[4])
{
    M open = NO;
#if HEALTH
    V left[6];
    load_block(in[3], in_step[3], column, lanes, 6, left);
    for (int j = 0; j < 6; ++j) {
        open |= ~(left[j] == 1.0);
    }
#endif
#if LATENCY > 0
    for (int i = 0; i < 16; ++i) {
        x[i] = SELECT(FABS(x[i]) == INFINITY, ALL(NAN), x[i]); /* infinitely safe is no state either */
    }
    for (int k = 0; k < LATENCY; ++k) {
        V u[6];
        V x_after[16];
        V error_bound_after[4];
        load_block(in[2], in_step[2], 6 * k * in_step[2] + column, lanes, 6, u);
        predict(x, error_bound, u, x_after, error_bound_after);
        memcpy(x, x_after, sizeof x_after);
        memcpy(error_bound, error_bound_after, sizeof error_bound_after);
    }
#endif
    return open;
}

long filter_batch(long first, long last, const void *const *in, const long *in_step, void *const *out,
                  const long *out_step)
{
    long unsolved = 0;
#if FLIES
    struct pending pending = {.refused = {.count = 0}};
#endif
    for (long column = first; column < last; column += W) {
        const long lanes = last - column;
        V y[SEEN];
        V desired[6];
        V numbers[6 + 2 * CONSTRAINTS]; /* control, slack, h */
        V error_bound[4] = {{0}};
        V program_status[2];
        M active[CONSTRAINTS];
        M open[1];
        M unsure = NO;
        load_block(in[0], in_step[0], column, lanes, 16, y);
        load_block(in[1], in_step[1], column, lanes, 6, desired);
        const M weak = bring_up_to_date(in, in_step, column, lanes, y, error_bound);
        memcpy(&y[16], error_bound, (SEEN - 16) * sizeof(V));
        first_attempt(y, desired, numbers, &numbers[6], &numbers[6 + CONSTRAINTS], program_status, active, open);
        M alone = open[0] | weak; /* filtered one by one */
#if FLIES
        V after[16];
        M hopes;
        unsure = are_unsure(y, numbers, program_status, after, &hopes);
#elif CHECKED
        unsure = are_unsure(y, numbers, program_status);
        alone |= unsure;
#endif
        for (int k = 0; k < 6 + 2 * CONSTRAINTS; ++k) {
            store_double(out[NUMBERS], k * out_step[NUMBERS] + column, lanes, numbers[k]);
        }
        store_statuses(program_status, differ(desired, numbers), ALL_CHECKED ? ~unsure : NO, active, out, out_step, column, lanes);
        for (int lane = 0; lane < W && lane < lanes; ++lane) {
            unsolved += alone[lane] ? filter_one(column + lane, in, in_step, out, out_step) : 0;
        }
#if FLIES
        if (ANY(unsure & ~alone)) {
            struct waiting block;
            memcpy(block.y, y, sizeof y);
            memcpy(block.desired, desired, sizeof desired);
            memcpy(block.control, numbers, sizeof block.control);
            memcpy(block.slack, &numbers[6], sizeof block.slack);
            memcpy(block.h, &numbers[6 + CONSTRAINTS], sizeof block.h);
            memcpy(block.program_status, program_status, sizeof program_status);
            for (int lane = 0; lane < W; ++lane) {
                block.column[lane] = column + lane;
            }
            look_closely(unsure & ~alone, hopes, after, &block, lanes, &pending, out, out_step);
        }
#endif
    }
#if FLIES
    finish(&pending, out, out_step);
#endif
    return unsolved;
}
