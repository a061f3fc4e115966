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

/* Lanes whose torque is not seen to keep the attitude's limits and to leave a way to rest, or in which a limit of the
 * user's own yields; elsewhere what the rows of torque lacked was the rows' alone. */
static M check_turn(const V x[16], const V error_bound[4], struct block *block)
{
#if TURN
    V least[1];
    turn_verified(x, block->numbers, error_bound, least);
    M found = ~(least[0] >= 0.0);
    for (int k = KEPT_LIMITS; k < CONSTRAINTS; ++k) {
        found |= block->numbers[6 + k] > 0.0;
    }
    for (int k = MOTION_LIMITS; k < KEPT_LIMITS; ++k) {
        block->numbers[6 + k] = SELECT(found, block->numbers[6 + k], ALL(0.0));
    }
    block->program_status[1] = SELECT(found, block->program_status[1], MIN(block->program_status[1], ALL(1.0)));
    return found;
#else
    (void)x;
    (void)error_bound;
    (void)block;
    return NO;
#endif
}

/* Lanes whose thrust is not seen to keep the limits of motion and to leave a way into the haven, likewise. */
static M check_thrust(const V x[16], const V error_bound[4], struct block *block)
{
#if HELD_CALLS > 0
    V ends[HELD_CALLS][16];
    V bounds[HELD_CALLS][4];
    V grown[HELD_CALLS + 1];
    V widest[4];
    V late[1];
    V least[1];
    M found = NO;
    const V *now = x;
    const V *bound = error_bound;
    grown[0] = bound[1];
    for (int call = 0; call < HELD_CALLS; ++call) {
        homing_look(now, block->numbers, bound, ends[call], bounds[call], least);
        found |= ~(least[0] >= 0.0);
        now = ends[call];
        bound = bounds[call];
        grown[call + 1] = bound[1];
    }
    for (int call = 0; call < HELD_CALLS; ++call) { /* all at once, see homing.c */
        const V *middle = ends[(HELD_CALLS - 1) / 2];
        V shifted[4];
        memcpy(shifted, bounds[call], sizeof shifted);
        for (int k = 0; k < 2; ++k) {
            V sum = ALL(0.0);
            for (int i = 3 * k; i < 3 * k + 3; ++i) {
                sum += (ends[call][i] - middle[i]) * (ends[call][i] - middle[i]);
            }
            shifted[k] += SQRT(sum);
        }
        const V since = bounds[call][1] - ((call + 1 >= LATENCY) ? grown[call + 1 - LATENCY] : ALL(0.0));
        late[0] = call ? MAX(late[0], since) : since;
        for (int i = 0; i < 4; ++i) {
            widest[i] = call ? MAX(widest[i], shifted[i]) : shifted[i];
        }
    }
    homing_way(ends[(HELD_CALLS - 1) / 2], widest, late, least);
    found |= ~(least[0] >= 0.0);
    for (int k = KEPT_LIMITS; k < CONSTRAINTS; ++k) {
        found |= block->numbers[6 + k] > 0.0;
    }
    for (int k = 0; k < MOTION_LIMITS; ++k) {
        block->numbers[6 + k] = SELECT(found, block->numbers[6 + k], ALL(0.0));
    }
    block->program_status[0] = SELECT(found, block->program_status[0], MIN(block->program_status[0], ALL(1.0)));
    return found;
#else
    (void)x;
    (void)error_bound;
    (void)block;
    return NO;
#endif
}

long filter_batch(long first, long last, const void *const *in, const long *in_step, void *const *out,
                  const long *out_step)
{
    long unsolved = 0;
    struct waiting these = {.count = 0};
    for (long column = first; column < last; column += W) {
        const long lanes = last - column;
        V x[16];
        V desired[6];
        V left[6];
        V wish[6];
        V error_bound[4] = {{0}};
        struct block block = {0};
        M thrust_alone;
        load_block(in[0], in_step[0], column, lanes, 16, x);
        load_block(in[1], in_step[1], column, lanes, 6, desired);
        load_block(in[3], in_step[3], column, lanes, 6, left);
        for (int i = 0; i < 16; ++i) {
            x[i] = SELECT(FABS(x[i]) == INFINITY, ALL(NAN), x[i]); /* infinitely safe is no state either */
        }
        begin(desired, left, wish, block.numbers, block.program_status, block.open);
        bring_up_to_date(in[2], in_step[2], column, lanes, left, x, error_bound);
        torque_correct(x, error_bound, left, wish, block.numbers, &block);
        const M unturned = check_turn(x, error_bound, &block);
        thrust_correct(x, error_bound, left, wish, block.numbers, &block);
        const M unhomed = check_thrust(x, error_bound, &block);
        const M unseen = unsure(x, block.numbers, &thrust_alone) | unturned | unhomed;
        nothing_yields(unseen, block.program_status, &block.numbers[6]);
        for (int k = 0; k < 6 + 4 * CONSTRAINTS; ++k) {
            store_double(out[NUMBERS], k * out_step[NUMBERS] + column, lanes, block.numbers[k]);
        }
        store_statuses(block.program_status, differ(desired, block.numbers), (BACKUP || (TURN && HELD_CALLS > 0)) ? ~unseen : NO, block.active, out, out_step, column, lanes);
        unsolved += finish(block.open[0] | unseen, thrust_alone, &these, x, block.numbers, column, lanes,
                           in, in_step, out, out_step);
    }
    unsolved += look_closely(&these, in, in_step, out, out_step);
    return unsolved;
}
