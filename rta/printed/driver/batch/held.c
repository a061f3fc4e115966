/* Attempts all programs, W spacecraft at a time, torque first, and has those that are left searched for one by one. */

/* Brings states up to date by the controls that were sent since they were measured. */
static void bring_up_to_date(const void *sent, long step, long column, long lanes, const V left[6], V x[16],
                             V error_bound[4])
{
#if LATENCY > 0
    for (int k = 0; k < LATENCY; ++k) {
        V u[6];
        V x_after[16];
        V error_bound_after[4];
        load_block(sent, step, 6 * k * step + column, lanes, 6, u);
        for (int j = 0; j < 6; ++j) {
            u[j] = left[j] * u[j];
        }
        predict(x, error_bound, u, x_after, error_bound_after);
        memcpy(x, x_after, sizeof x_after);
        memcpy(error_bound, error_bound_after, sizeof error_bound_after);
    }
#endif
}

long filter_batch(long first, long last, const void *const *in, const long *in_step, void *const *out,
                  const long *out_step)
{
    long unsolved = 0;
    for (long column = first; column < last; column += W) {
        const long lanes = last - column;
        V x[16];
        V desired[6];
        V left[6];
        V wish[6];
        V error_bound[4] = {{0}};
        struct block block;
        load_block(in[0], in_step[0], column, lanes, 16, x);
        load_block(in[1], in_step[1], column, lanes, 6, desired);
        load_block(in[3], in_step[3], column, lanes, 6, left);
        for (int i = 0; i < 16; ++i) {
            x[i] = SELECT(FABS(x[i]) == INFINITY, ALL(NAN), x[i]); /* infinitely safe is no state either */
        }
        begin(desired, left, wish, block.numbers, block.program_status, block.open);
        bring_up_to_date(in[2], in_step[2], column, lanes, left, x, error_bound);
        torque_correct(x, error_bound, left, wish, block.numbers, &block);
        thrust_correct(x, error_bound, left, wish, block.numbers, &block);
        const M unseen = unsure(x, block.numbers);
        nothing_yields(unseen, block.program_status, &block.numbers[6]);
        for (int k = 0; k < 6 + 4 * CONSTRAINTS; ++k) {
            store_double(out[NUMBERS], k * out_step[NUMBERS] + column, lanes, block.numbers[k]);
        }
        store_statuses(block.program_status, differ(desired, block.numbers), BACKUP ? ~unseen : NO, block.active, out, out_step, column, lanes);
        for (int lane = 0; lane < W && lane < lanes; ++lane) {
            if (block.open[0][lane] || unseen[lane]) {
                unsolved += filter_one(column + lane, in, in_step, out, out_step);
            }
        }
    }
    return unsolved;
}
