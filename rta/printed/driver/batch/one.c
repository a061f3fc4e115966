static void give(const struct safety_filter_input *given, const struct safety_filter_output *found, long column,
                 void *const *out, const long *out_step)
{
    double *numbers = (double *)out[NUMBERS] + column;
    long *status = (long *)out[STATUSES] + column;
    unsigned char *truths = (unsigned char *)out[TRUTHS] + column;
    truths[0] = 0; /* another control than the desired one is applied */
    for (int j = 0; j < 6; ++j) {
        numbers[j * out_step[NUMBERS]] = found->control[j];
        truths[0] |= (unsigned char)!(found->control[j] == given->desired[j]);
    }
    for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
        numbers[(6 + k) * out_step[NUMBERS]] = found->slack[k];
        numbers[(6 + SAFETY_FILTER_CONSTRAINTS + k) * out_step[NUMBERS]] = found->h[k];
        truths[(3 + k) * out_step[TRUTHS]] = (unsigned char)found->active[k];
    }
    truths[out_step[TRUTHS]] = (unsigned char)found->verified;
    truths[2 * out_step[TRUTHS]] = (unsigned char)found->backup;
    status[0] = found->status;
    for (int group = 0; group < 2; ++group) {
        status[(1 + group) * out_step[STATUSES]] = found->program_status[group];
    }
}

static void column_of(safety_filter_real *to, int count, const void *from, long step, long column)
{
    for (int i = 0; i < count; ++i) {
        to[i] = (safety_filter_real)((const double *)from)[i * step + column];
    }
}

long filter_one(long column, const void *const *in, const long *in_step, void *const *out, const long *out_step)
{
    struct safety_filter_input given = {{0.0}};
    struct safety_filter_output found;
    column_of(given.state, 16, in[0], in_step[0], column);
    column_of(given.desired, 6, in[1], in_step[1], column);
#if HAS_BOUNDS
    column_of(given.left, 6, in[3], in_step[3], column);
    for (int k = 0; k < SAFETY_FILTER_LATENCY; ++k) {
        safety_filter_real *sent = given.sent[given.sent_count];
        column_of(sent, 6, in[2], in_step[2], 6 * k * in_step[2] + column);
        int younger = 0; /* the state is younger than that control */
        for (int j = 0; j < 6; ++j) {
            younger |= isnan(sent[j]);
        }
        given.sent_count += younger ? 0 : 1;
    }
#endif
    safety_filter(&given, &found);
    give(&given, &found, column, out, out_step);
    return found.status == NO_SOLUTION;
}
