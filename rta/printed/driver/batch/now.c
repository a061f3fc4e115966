/* Attempts all programs, W spacecraft at a time, and has those that are left solved one by one. */

long filter_batch(long first, long last, const void *const *in, const long *in_step, void *const *out,
                  const long *out_step)
{
    long unsolved = 0;
    struct waiting these = {.count = 0};
    for (long column = first; column < last; column += W) {
        const long lanes = last - column;
        V x[16];
        V desired[6];
        V numbers[6 + 2 * CONSTRAINTS]; /* control, slack, h */
        V program_status[2];
        M active[CONSTRAINTS];
        M left[1];
        M thrust_alone;
        load_block(in[0], in_step[0], column, lanes, 16, x);
        load_block(in[1], in_step[1], column, lanes, 6, desired);
        first_attempt(x, desired, numbers, &numbers[6], &numbers[6 + CONSTRAINTS], program_status, active, left);
        const M unseen = unsure(x, numbers, &thrust_alone);
        nothing_yields(unseen, program_status, &numbers[6]);
        for (int k = 0; k < 6 + 2 * CONSTRAINTS; ++k) {
            store_double(out[NUMBERS], k * out_step[NUMBERS] + column, lanes, numbers[k]);
        }
        store_statuses(program_status, differ(desired, numbers), BACKUP ? ~unseen : NO, active, out, out_step, column, lanes);
        unsolved += finish(left[0] | unseen, thrust_alone, &these, x, numbers, column, lanes, in, in_step,
                           out, out_step);
    }
    unsolved += look_closely(&these, in, in_step, out, out_step);
    return unsolved;
}
