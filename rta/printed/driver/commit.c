/* Propose, check, commit: a control is applied if all limits are kept while it is held and a way to rest begins at its
 * end; else the nearest control that is, on the way to the backup law's, which was verified one call ago. */

static double speed_of(const double at[10])
{
    return sqrt(dot(&at[3], &at[3], 3));
}

/* Whether a way keeps the limits of motion and comes to rest, hold by hold. */
static int comes_to_rest(const double from[10])
{
    double at[10];
    double after[10];
    double least[1] = {0.0};
    int is_at_rest = 0;
    copy(at, from, 10);
    for (int k = 0; (k < BRAKING_HOLDS) && (is_at_rest == 0) && (least[0] >= 0.0); ++k) {
        const double speed = speed_of(at);
        braked(at, after, least);
        copy(at, after, 10);
        is_at_rest = (speed <= AT_REST) ? 1 : 0;
    }
    return ((is_at_rest != 0) && (least[0] >= 0.0)) ? 1 : 0;
}

/* Whether thrust of a control, with its torque, keeps the limits of motion and leaves a way to rest. */
static int thrust_is_safe(const double x[16], const double control[6])
{
    double least[1];
    int found = 1;
    thrust_glance(x, control, least);
    if (!(least[0] >= 0.0)) {
        double y[16];
        double at[10];
        copy(y, x, 16);
        least[0] = 0.0;
        for (int i = 0; (i < LOOKS) && (least[0] >= 0.0); ++i) {
            double later[16];
            thrust_look(y, control, later, least);
            copy(y, later, 16);
        }
        beginning(y, at);
        found = ((least[0] >= 0.0) && (comes_to_rest(at) != 0)) ? 1 : 0;
    }
    return found;
}

/* Whether torque of a control keeps the attitude's limits and leaves a way to rest. */
static int torque_is_safe(const double x[16], const double control[6])
{
    double least[1];
    torque_sight(x, control, least);
    if (!(least[0] >= 0.0)) {
        torque_verified(x, control, least);
    }
    return (least[0] >= 0.0) ? 1 : 0;
}

static int is_safe(int group, const double x[16], const double control[6])
{
    return (group == THRUST) ? thrust_is_safe(x, control) : torque_is_safe(x, control);
}

/* The nearest control that is safe on the way to the backup law's; returns 0 if not even that is seen to be. */
static int go_to_backup(int group, const double x[16], double control[6])
{
    static const double shares[SHARE_COUNT] = SHARES;
    double proposed[3];
    double law[3];
    copy(proposed, &control[3 * group], 3);
    if (group == THRUST) {
        brake_law(x, control, law);
    } else {
        slew_law(x, law);
    }
    int found = 0;
    for (int i = 0; (i < SHARE_COUNT) && (found == 0); ++i) {
        for (int j = 0; j < 3; ++j) {
            const double tried = proposed[j] + (shares[i] * (law[j] - proposed[j]));
            control[(3 * group) + j] = clip(tried, smaller(proposed[j], law[j]), larger(proposed[j], law[j]));
        }
        found = is_safe(group, x, control);
    }
    return found;
}

/* Whether one of a group's limits that a way keeps is violated already, or the state holds no numbers: there is none then. */
static int is_broken(int group, const double x[16], const struct safety_filter_output *out)
{
    const int first = (group == THRUST) ? 0 : MOTION_LIMITS;
    const int last = (group == THRUST) ? MOTION_LIMITS : (MOTION_LIMITS + ATTITUDE_LIMITS);
    int found = 0;
    for (int k = first; k < last; ++k) {
        found |= (out->h[k] >= 0.0) ? 0 : 1;
    }
    for (int k = MOTION_LIMITS + ATTITUDE_LIMITS; (k < KEPT_LIMITS) && (group == TORQUE); ++k) {
        found |= (out->h[k] >= -RATES_ROUNDED) ? 0 : 1; /* rates at their limit, where the plant holds them */
    }
    for (int i = 0; i < 16; ++i) {
        found |= (isfinite(x[i]) != 0) ? 0 : 1;
    }
    return found;
}

/* The limits that a way keeps are kept: what their rows lacked was the rows' alone. */
static void nothing_yields(int group, struct safety_filter_output *out)
{
    double left = 0.0;
    for (int k = 0; k < CONSTRAINTS_OF[group]; ++k) {
        const int place = PLACE[group][k];
        if (IS_KEPT[place] != 0) {
            out->slack[place] = 0.0;
        }
        left = larger(left, out->slack[place]);
    }
    if ((out->program_status[group] == SLACK) && !(left > SLACK_ROUNDED)) {
        out->program_status[group] = HARD;
    }
}

/* Both groups follow their laws: the way was verified with both. */
static void follow(const double x[16], double control[6], int verified[2])
{
    slew_law(x, &control[3]);
    brake_law(x, control, control);
    verified[TORQUE] = torque_is_safe(x, control);
    verified[THRUST] = thrust_is_safe(x, control);
}

/* Torque comes first, since the attitude decides where thrust acts. */
static void commit(const double x[16], double control[6], struct safety_filter_output *out)
{
    int verified[2] = {0, 0};
    int changed[2] = {0, 0};
    for (int group = TORQUE; group >= THRUST; --group) {
        if (is_broken(group, x, out) == 0) {
            verified[group] = is_safe(group, x, control);
            if (verified[group] == 0) {
                verified[group] = go_to_backup(group, x, control);
                changed[group] = 1;
            }
        }
    }
    if ((changed[THRUST] != 0) && (verified[THRUST] == 0) && (is_broken(TORQUE, x, out) == 0)) {
        follow(x, control, verified);
        changed[TORQUE] = 1;
    }
    for (int group = THRUST; group <= TORQUE; ++group) {
        if ((changed[group] != 0) && (out->program_status[group] < HARD)) {
            out->program_status[group] = HARD;
        }
        if (verified[group] != 0) {
            nothing_yields(group, out);
        }
    }
    out->backup = changed[THRUST] | changed[TORQUE];
    out->verified = verified[THRUST] & verified[TORQUE];
}
