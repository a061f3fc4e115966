/* What the page asks of one filter; it follows safety_filter.c, whose functions it calls. PLAY gives each a name of its own. */

void PLAY(correct)(const struct safety_filter_input *in, struct safety_filter_output *out)
{
    safety_filter(in, out);
}

void PLAY(assist)(const double x[16], double torque[3])
{
    assistant(x, torque);
}

void PLAY(guide)(const double x[16], const double score[1], double u[6])
{
    guidance(x, score, u);
}

/* The way to rest that begins where a control has been held: places, of which there are `most` at most; how many. */
int PLAY(way)(const double x[16], const double control[6], double *places, int most)
{
    int count = 0;
#if BACKUP
    double least[1];
    double y[16];
    double at[10];
    double after[10];
    int is_at_rest = 0;
    copy(y, x, 16);
    for (int i = 0; i < LOOKS; ++i) {
        double later[16];
        thrust_look(y, control, later, least);
        copy(y, later, 16);
    }
    beginning(y, at);
    for (int k = 0; (k < BRAKING_HOLDS) && (count < most) && (is_at_rest == 0); ++k) {
        copy(&places[3 * count], at, 3);
        count += 1;
        is_at_rest = (speed_of(at) <= AT_REST) ? 1 : 0;
        braked(at, after, least);
        copy(at, after, 10);
    }
#else
    (void)x;
    (void)control;
    (void)places;
    (void)most;
#endif
    return count;
}
