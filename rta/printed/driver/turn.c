/* Propose, check, commit, of torque alone: it is applied if the attitude's limits are kept while it is held, however long
 * within the bounds, and a way to rest begins then; else the nearest that is, on the way to the backup law's. */

static int turn_is_safe(const double x[16], const double error_bound[4], const double control[6])
{
    double least[1];
    turn_verified(x, control, error_bound, least);
    return (least[0] >= 0.0) ? 1 : 0;
}

/* The nearest torque that is safe on the way to the backup law's; returns 0 if not even that is seen to be. */
static int turn_to_backup(const double x[16], const double error_bound[4], double control[6])
{
    static const double shares[SHARE_COUNT] = SHARES;
    double proposed[3];
    double law[3];
    int found = 0;
    copy(proposed, &control[3], 3);
    turn_law(x, law);
    for (int i = 0; (i < SHARE_COUNT) && (found == 0); ++i) {
        for (int j = 0; j < 3; ++j) {
            const double tried = proposed[j] + (shares[i] * (law[j] - proposed[j]));
            control[3 + j] = clip(tried, smaller(proposed[j], law[j]), larger(proposed[j], law[j]));
        }
        found = turn_is_safe(x, error_bound, control);
    }
    return found;
}

/* Whether each of the attitude's limits may be kept now, and the state holds numbers: else there is no way. */
static int may_be_kept(const double x[16], const double error_bound[4])
{
    double least[1];
    int found = 1;
    turn_kept(x, error_bound, least);
    for (int i = 0; i < 16; ++i) {
        found &= (isfinite(x[i]) != 0) ? 1 : 0;
    }
    for (int i = 0; i < 4; ++i) {
        found &= (isfinite(error_bound[i]) != 0) ? 1 : 0;
    }
    return ((found != 0) && (least[0] >= 0.0)) ? 1 : 0;
}

/* The attitude's limits are kept: what their rows lacked was the rows' alone. */
static void nothing_of_torque_yields(struct safety_filter_output *out)
{
    double left = 0.0;
    for (int k = 0; k < CONSTRAINTS_OF[TORQUE]; ++k) {
        const int place = PLACE[TORQUE][k];
        if (IS_KEPT[place] != 0) {
            out->slack[place] = 0.0;
        }
        left = larger(left, out->slack[place]);
    }
    if ((out->program_status[TORQUE] == SLACK) && !(left > SLACK_ROUNDED)) {
        out->program_status[TORQUE] = HARD;
    }
}

/* Returns whether the torque that is applied is verified. */
static int commit_turn(const double x[16], const double error_bound[4], double control[6],
                       struct safety_filter_output *out)
{
    int verified = 0;
    if (may_be_kept(x, error_bound) != 0) {
        verified = turn_is_safe(x, error_bound, control);
        if (verified == 0) {
            verified = turn_to_backup(x, error_bound, control);
            out->backup = 1;
            if (out->program_status[TORQUE] < HARD) {
                out->program_status[TORQUE] = HARD;
            }
        }
        if (verified != 0) {
            nothing_of_torque_yields(out);
        }
    }
    return verified;
}
