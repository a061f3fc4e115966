/* The check with error bounds, of each group apart: torque leaves a backup trajectory to rest, thrust one into
 * the terminal set, from every state that may be true and wherever a hold may end. */

#if HELD_CALLS > 0
/* Where a hold may end, call by call. */
struct hold_ends {
    V x[HELD_CALLS][16];
    V error_bound[HELD_CALLS][4];
    V late[HELD_CALLS];
};

static V apart(const V first[3], const V last[3])
{
    V sum = ALL(0.0);
    for (int i = 0; i < 3; ++i) {
        sum += (first[i] - last[i]) * (first[i] - last[i]);
    }
    return SQRT(sum);
}

/* Whether a backup trajectory begins wherever a hold may end, by one look. */
static M has_trajectory_at_a_glance(const struct hold_ends *ends)
{
    const V *middle = ends->x[(HELD_CALLS - 1) / 2];
    V widest[4];
    V late[1];
    V least[1];
    for (int call = 0; call < HELD_CALLS; ++call) {
        V bound[4];
        assign(bound, ends->error_bound[call], 4);
        bound[0] += apart(ends->x[call], middle);
        bound[1] += apart(&ends->x[call][3], &middle[3]);
        for (int k = 0; k < 4; ++k) {
            widest[k] = (call > 0) ? MAX(widest[k], bound[k]) : bound[k];
        }
        late[0] = (call > 0) ? MAX(late[0], ends->late[call]) : ends->late[call];
    }
    motion_trajectory_margin(middle, widest, late, least);
    return least[0] >= 0.0;
}

/* Whether thrust keeps the limits of motion and leaves a backup trajectory; `closely`: by a look at each end where one is not enough. */
static M keeps_motion(const V y[SEEN], const V control[6], M asked, int closely)
{
    struct hold_ends ends;
    V grown[HELD_CALLS + 1];
    V least[1];
    const V *now = y;
    const V *bound = &y[16];
    M found = asked;
    grown[0] = bound[1];
    for (int call = 0; (call < HELD_CALLS) && ANY(found); ++call) {
        motion_hold(now, control, bound, ends.x[call], ends.error_bound[call], least);
        found = AND(found, least[0] >= 0.0);
        now = ends.x[call];
        bound = ends.error_bound[call];
        grown[call + 1] = bound[1];
        ends.late[call] = (call + 1 >= LATENCY) ? (bound[1] - grown[call + 1 - LATENCY]) : bound[1];
    }
    if (!ANY(found)) {
        return found;
    }
    const M seen = AND(found, has_trajectory_at_a_glance(&ends));
    M open = (closely != 0) ? AND(found, NOT(seen)) : NO;
    for (int call = 0; (call < HELD_CALLS) && ANY(open); ++call) {
        motion_trajectory_margin(ends.x[call], ends.error_bound[call], &ends.late[call], least);
        open = AND(open, least[0] >= 0.0);
    }
    return OR(seen, open);
}
#endif

/* As are_safe; `closely`: see `keeps_motion`. Thrust is not looked at beside torque that is refused: it is with what is applied. */
static void are_seen_safe(const V y[SEEN], const V control[6], const M asked[2], int closely, M found[2])
{
    M alone = asked[THRUSTS];
    found[THRUSTS] = NO;
    found[TORQUES] = NO;
    (void)closely;
#if ATTITUDE_CHECKED
    if (ANY(asked[TORQUES])) {
        V least[1];
        attitude_verified(y, control, &y[16], least);
        found[TORQUES] = least[0] >= 0.0;
        alone = AND(alone, OR(found[TORQUES], NOT(asked[TORQUES])));
    }
#endif
#if HELD_CALLS > 0
    if (ANY(alone)) {
        found[THRUSTS] = keeps_motion(y, control, alone, closely);
    }
#endif
    (void)alone;
}

static void are_safe(const V y[SEEN], const V control[6], const M broken[LIMITS], const M asked[2], M found[2])
{
    (void)broken;
    are_seen_safe(y, control, asked, 1, found);
}

/* A group is not checked where one of its limits is broken beyond doubt: no backup trajectory begins there. */
static void are_fit(const V y[SEEN], const V h[CONSTRAINTS], M broken[LIMITS], M fit[2])
{
    V least[2];
    const M possible = is_state(y);
    (void)h;
    may_be_kept(y, least);
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        fit[group] = AND(possible, least[group] >= 0.0);
    }
    for (int k = 0; k < LIMITS; ++k) {
        broken[k] = NO;
    }
}

/* The laws were tried already, and no flight of theirs is known. */
static M follow(const V y[SEEN], M open, const M broken[LIMITS], V control[6])
{
    (void)y;
    (void)open;
    (void)broken;
    (void)control;
    return NO;
}
