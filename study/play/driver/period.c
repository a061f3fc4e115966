/* What the page asks of one filter; it follows safety_filter.c, whose functions it calls. PLAY gives each a name of its own. */

/* From a state as it is seen, and what is desired, to a control, which rows act, and status, verified, backup.
 * `sent` are the controls held since the state was measured, the oldest first. */
void PLAY(correct)(const double x[16], const double desired[6], const double *sent, int count, double control[6],
                   double active[SAFETY_FILTER_CONSTRAINTS], double answer[3])
{
    struct safety_filter_input in = {.sent_count = count, .left = {1.0, 1.0, 1.0, 1.0, 1.0, 1.0}};
    struct safety_filter_output out;
    copy(in.state, x, 16);
    copy(in.desired, desired, 6);
    for (int i = 0; (i < count) && (i < SAFETY_FILTER_SENT_ROOM); ++i) {
        copy(in.sent[i], &sent[6 * i], 6);
    }
    safety_filter(&in, &out);
    copy(control, out.control, 6);
    for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
        active[k] = out.active[k];
    }
    answer[0] = out.status;
    answer[1] = out.verified;
    answer[2] = out.backup;
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
#if FLIES
    static const int none[LIMITS] = {0};
    double y[16];
    double u[6];
    double after[16];
    double least[LIMITS];
    int arrived[2] = {0, 0};
    flown(x, control, y, least);
    for (int k = 0; (k < FLIGHT_HOLDS) && (count < most) && (arrived[THRUST] == 0); ++k) {
        copy(&places[3 * count], y, 3);
        count += 1;
        have_arrived(y, none, arrived);
        backup_torque(y, &u[3]);
        backup_thrust(y, &u[3], u);
        flown(y, u, after, least);
        copy(y, after, 16);
    }
#else
    (void)x;
    (void)control;
    (void)places;
    (void)most;
#endif
    return count;
}
