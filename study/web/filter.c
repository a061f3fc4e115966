/* Calls of the page to one filter, whose safety_filter.c comes before this text. NAME adds the filter's number to each
 * name.
 */

/* Calls the filter with `seen` and `desired`; writes `control`, `active`, and status, verified, backup as `answer`. */
void NAME(ask)(void)
{
    struct safety_filter_input in = {.sent_count = sent_count};
    struct safety_filter_output out;
    memcpy(in.state, seen, sizeof in.state);
    memcpy(in.desired, desired, sizeof in.desired);
    for (int i = 0; (i < sent_count) && (i < SAFETY_FILTER_SENT_ROOM); ++i) {
        memcpy(in.sent[i], &sent[6 * i], sizeof in.sent[i]);
    }
    safety_filter(&in, &out);
    memcpy(control, out.control, sizeof out.control);
    for (int k = 0; k < SAFETY_FILTER_CONSTRAINTS; ++k) {
        active[k] = out.active[k];
    }
    answer[0] = out.status;
    answer[1] = out.verified;
    answer[2] = out.backup;
}

/* Writes torque that points the camera at the chief into `desired`. */
void NAME(assist)(void)
{
    assistant(seen, &desired[3]);
}

/* Writes the classical guidance's control into `desired`. */
void NAME(guide)(void)
{
    guidance(seen, score, desired);
}

/* Writes the backup trajectory after `control` into `way`; returns its number of points. */
int NAME(rest)(void)
{
    int count = 0;
#if FLIES
    double x[16];
    double u[6];
    double after[16];
    double law[6];
    int arrived[1] = {0};
    memcpy(x, state, sizeof x);
    memcpy(u, control, sizeof u);
    while ((count < PLACES) && (arrived[0] == 0)) {
        turn_to_rest(x, u, after, law, arrived);
        memcpy(&way[3 * count], after, 3 * sizeof after[0]);
        memcpy(x, after, sizeof x);
        memcpy(u, law, sizeof u);
        count += 1;
    }
#endif
    return count;
}
