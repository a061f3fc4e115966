/* Whether the laws' flight from each state keeps the limits of each group that are not broken, and ends; of groups that are
 * asked for. In: states, broken limits, groups. */
long filter_flights(long first, long last, const void *const *in, const long *in_step, void *const *out,
                    const long *out_step)
{
    for (long column = first; column < last; column += W) {
        const long lanes = last - column;
        V x[16];
        M broken[LIMITS];
        M asked[2];
        M found[2];
        load_block(in[0], in_step[0], column, lanes, 16, x);
        for (int k = 0; k < LIMITS; ++k) {
            broken[k] = load_bool(in[1], k * in_step[1] + column, lanes);
        }
        for (int group = THRUSTS; group <= TORQUES; ++group) {
            asked[group] = load_bool(in[2], group * in_step[2] + column, lanes);
        }
        have_ways(x, broken, asked, found);
        for (int group = THRUSTS; group <= TORQUES; ++group) {
            store_bool(out[0], group * out_step[0] + column, lanes, found[group]);
        }
    }
    return 0;
}
