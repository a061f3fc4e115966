/* The filter of one spacecraft, called for columns of a batch; arrays lie component first, `*_step` between two. */

static void take_column(safety_filter_real *to, int count, const double *from, long step)
{
    for (int i = 0; i < count; ++i) {
        to[i] = (safety_filter_real)from[i * step];
    }
}

/* Numbers: control, slack, h, uncertainty, tightened. Integers: statuses of both programs, active rows. */
static void give_column(const struct safety_filter_output *found, double *numbers, long step, int *integers,
                        long integers_step)
{
    for (int j = 0; j < 6; ++j) {
        numbers[j * step] = (double)found->control[j];
    }
    for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
        const safety_filter_real each[4] = {found->slack[k], found->h[k], found->uncertainty[k], found->tightened[k]};
        for (int i = 0; i < 4; ++i) {
            numbers[(6 + (i * SAFETY_FILTER_CONSTRAINTS) + k) * step] = (double)each[i];
        }
        integers[(2 + k) * integers_step] = found->active[k];
    }
    integers[0] = found->program_status[0];
    integers[integers_step] = found->program_status[1];
}

/* `sent`: 6 x latency components, NaN where a state is younger than a control. */
void filter_columns(long first, long last, const void *const *in, const long *in_step, void *const *out,
                    const long *out_step)
{
    for (long column = first; column < last; ++column) {
        struct safety_filter_input given = {.sent_count = 0};
        struct safety_filter_output found;
        take_column(given.state, 16, (const double *)in[0] + column, in_step[0]);
        take_column(given.desired, 6, (const double *)in[1] + column, in_step[1]);
        take_column(given.left, 6, (const double *)in[3] + column, in_step[3]);
        for (int k = 0; k < SAFETY_FILTER_LATENCY; ++k) {
            safety_filter_real *sent = given.sent[given.sent_count];
            int younger = 0;
            take_column(sent, 6, (const double *)in[2] + (6 * k * in_step[2]) + column, in_step[2]);
            for (int j = 0; j < 6; ++j) {
                younger = ((younger != 0) || isnan(sent[j])) ? 1 : 0;
            }
            given.sent_count += (younger != 0) ? 0 : 1;
        }
        safety_filter(&given, &found);
        give_column(&found, (double *)out[0] + column, out_step[0], (int *)out[1] + column, out_step[1]);
    }
}
