/* Components 0 to count of W columns. */
static void load_block(const void *in, long step, long column, long lanes, int count, V *to)
{
    for (int i = 0; i < count; ++i) {
        to[i] = load_double(in, i * step + column, lanes);
    }
}

/* Whether another control than the desired one is applied; a number that is none is another, too. */
static M differ(const V desired[6], const V control[6])
{
    M other = NO;
    for (int j = 0; j < 6; ++j) {
        other |= ~(control[j] == desired[j]);
    }
    return other;
}

/* Of W columns: the worse status, both, whether another control is applied, and which constraints are active. */
static void store_statuses(const V program_status[2], M intervened, M verified, const M active[CONSTRAINTS], void *const *out,
                           const long *out_step, long column, long lanes)
{
    const V status = MAX(program_status[0], program_status[1]);
    store_long(out[STATUSES], column, lanes, status);
    store_bool(out[TRUTHS], column, lanes, intervened);
    store_bool(out[TRUTHS], out_step[TRUTHS] + column, lanes, verified);
    store_bool(out[TRUTHS], 2 * out_step[TRUTHS] + column, lanes, NO);
    for (int group = 0; group < 2; ++group) {
        store_long(out[STATUSES], (1 + group) * out_step[STATUSES] + column, lanes, program_status[group]);
    }
    for (int k = 0; k < CONSTRAINTS; ++k) {
        store_bool(out[TRUTHS], (3 + k) * out_step[TRUTHS] + column, lanes, active[k]);
    }
}
