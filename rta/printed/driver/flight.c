/* The check without error bounds: the backup trajectory is the flight of both laws, until it is where they stay. */

/* The limits of thrust, and of torque, in the order of the constraints; the body rates are one. */
static const int FIRST_LIMIT[2] = {0, MOTION_LIMITS};
static const int LAST_LIMIT[2] = {MOTION_LIMITS, LIMITS};

/* Whether the least of each limit is not negative, of thrust and of torque, or it is broken already. */
static void are_kept(const V least[LIMITS], const M broken[LIMITS], M found[2])
{
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        found[group] = YES;
        for (int k = FIRST_LIMIT[group]; k < LAST_LIMIT[group]; ++k) {
            found[group] = AND(found[group], OR(least[k] >= KEPT, broken[k]));
        }
    }
}

/* Whether a state is where the laws stay: in a cone of attitudes, cool, charged, slow, and clear of chief and edge. Limits
 * that are broken excuse from what comes back slowly. */
static void have_arrived(const V x[16], const M broken[LIMITS], M found[2])
{
    V room[5];
    M inside[5];
    terminal_room(x, room);
    for (int i = 0; i < 5; ++i) {
        inside[i] = room[i] >= 0.0;
    }
    inside[1] = OR(inside[1], broken[TEMPERATURE_LIMIT]);
    inside[2] = OR(inside[2], broken[BATTERY_LIMIT]);
    inside[4] = OR(inside[4], OR(broken[SEPARATION_LIMIT], OR(broken[ZONE_LIMIT], broken[PASSIVE_LIMIT])));
    found[THRUSTS] = AND(inside[0], AND(inside[3], inside[4]));
    found[TORQUES] = AND(inside[0], AND(inside[1], inside[2]));
}

/* Flies states on for up to so many holds of the laws, at first with a look at all that is left of the flight at once. Alive: flights
 * that have kept the limits of each group and not ended; found: those that ended well, or are seen to keep them for good. */
static void fly_on(V x[16], const M broken[LIMITS], int holds, M alive[2], M found[2])
{
    for (int k = 0; (k < holds) && ANY(OR(alive[THRUSTS], alive[TORQUES])); ++k) {
        V u[6];
        V after[16];
        V least[LIMITS];
        M there[2];
        M fine[2] = {NO, NO};
        have_arrived(x, broken, there);
        if (k == 0) {
            at_once(x, least);
            are_kept(least, broken, fine);
        }
        for (int group = THRUSTS; group <= TORQUES; ++group) {
            found[group] = OR(found[group], AND(alive[group], OR(there[group], fine[group])));
            alive[group] = AND(alive[group], NOT(found[group]));
        }
        if (!ANY(OR(alive[THRUSTS], alive[TORQUES]))) {
            break;
        }
        backup_torque(x, &u[3]);
        backup_thrust(x, &u[3], u);
        if (ANY(alive[THRUSTS])) {
            flown(x, u, after, least);
        } else {
            for (int i = 0; i < MOTION_LIMITS; ++i) {
                least[i] = ALL(0.0);
            }
            attitude_flown(x, u, after, &least[MOTION_LIMITS]);
        }
        are_kept(least, broken, fine);
        for (int group = THRUSTS; group <= TORQUES; ++group) {
            alive[group] = AND(alive[group], fine[group]);
        }
        assign(x, after, 16);
    }
}

/* Whether the laws' flight keeps the limits of each group that is asked for, and ends. */
static void have_trajectories(const V x[16], const M broken[LIMITS], const M asked[2], M found[2])
{
    V y[16];
    M alive[2];
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        found[group] = NOT(asked[group]);
        alive[group] = asked[group];
    }
    assign(y, x, 16);
    for (int k = 0; k < FLIGHT_HOLDS; k += GLANCES) {
        fly_on(y, broken, GLANCES, alive, found);
    }
}

/* Whether a hold of a control, and the flight after it, keep the limits of each group that is asked for. */
static void are_safe(const V x[16], const V control[6], const M broken[LIMITS], const M asked[2], M found[2])
{
    V after[16];
    V least[LIMITS];
    M open[2];
    M kept[2];
    flown(x, control, after, least);
    are_kept(least, broken, kept);
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        open[group] = AND(asked[group], kept[group]);
    }
    have_trajectories(after, broken, open, found);
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        found[group] = AND(found[group], kept[group]);
    }
}

/* Which limits are violated already, from the values of the constraints. Rates may be at theirs, where the plant holds them. */
static void are_broken(const V h[CONSTRAINTS], M broken[LIMITS])
{
    broken[LIMITS - 1] = NO;
    for (int k = 0; k < (LIMITS - 1); ++k) {
        broken[k] = NOT(h[k] >= 0.0);
    }
    for (int k = LIMITS - 1; k < KEPT_LIMITS; ++k) {
        broken[LIMITS - 1] = OR(broken[LIMITS - 1], NOT(h[k] >= -RATES_ROUNDED));
    }
}

static void are_fit(const V y[SEEN], const V h[CONSTRAINTS], M broken[LIMITS], M fit[2])
{
    fit[THRUSTS] = is_state(y);
    fit[TORQUES] = fit[THRUSTS];
    are_broken(h, broken);
}

/* The laws' flight was looked at a call ago, if it was verified then. */
static M follow(const V y[SEEN], M open, const M broken[LIMITS], V control[6])
{
    V law[6];
    M found[2];
    const M asked[2] = {open, open};
    have_trajectories(y, broken, asked, found);
    backup_torque(y, &law[3]);
    backup_thrust(y, &law[3], law);
    const M followed = AND(open, AND(found[THRUSTS], found[TORQUES]));
    for (int j = 0; j < 6; ++j) {
        control[j] = SELECT(followed, law[j], control[j]);
    }
    return followed;
}
