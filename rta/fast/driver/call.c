/* Numbers as `filter` takes them. */
static void read(const safety_filter_real *from, int count, double *to)
{
    for (int i = 0; i < count; ++i) {
        to[i] = (double)from[i];
    }
}

static void write(const double *from, int count, safety_filter_real *to)
{
    for (int i = 0; i < count; ++i) {
        to[i] = (safety_filter_real)from[i];
    }
}

void safety_filter(const struct safety_filter_input *in, struct safety_filter_output *out)
{
    const int too_old = (in->sent_count > SAFETY_FILTER_LATENCY) ? 1 : 0;
    double state[16];
    double desired[6];
    double control[6];
    double slack[SAFETY_FILTER_CONSTRAINTS];
    double h[SAFETY_FILTER_CONSTRAINTS];
    double status[1];
    int intervened[1];
    read(in->state, 16, state);
    read(in->desired, 6, desired);
#if SAFETY_FILTER_LATENCY
    double sent[SAFETY_FILTER_LATENCY][6]; /* the newest last; NAN before the state was measured */
    const int count = (too_old != 0) ? SAFETY_FILTER_LATENCY : in->sent_count;
    for (int k = 0; k < SAFETY_FILTER_LATENCY; ++k) {
        const int from = k - (SAFETY_FILTER_LATENCY - count);
        for (int j = 0; j < 6; ++j) {
            sent[k][j] = (from < 0) ? NAN : (double)in->sent[from][j];
        }
    }
#endif
    filter(state, desired, SENT control, intervened, &out->verified, &out->backup, out->active, slack, status, h);
    write(control, 6, out->control);
    write(slack, SAFETY_FILTER_CONSTRAINTS, out->slack);
    write(h, SAFETY_FILTER_CONSTRAINTS, out->h);
    out->status = (too_old != 0) ? (int)SAFETY_FILTER_UNSOLVED : (int)status[0];
    out->verified = (too_old != 0) ? 0 : out->verified;
    out->violated = 0;
    for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
        out->violated = (h[k] < 0.0) ? 1 : out->violated;
    }
}
