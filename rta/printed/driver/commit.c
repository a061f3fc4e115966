/* Propose, check, commit: a control is applied if a hold of it, and the flight of both backup laws after it, keep all
 * limits and end where the laws stay; else the nearest that does, on the way to the laws' control; at last that.
 *
 * The same text checks one spacecraft and vectors of them: V is a number, M a truth value, of each. */

enum { THRUSTS = 0, TORQUES = 1 };

/* The limits of thrust, and of torque, in the order of the constraints; the body rates are one. */
static const int FIRST_LIMIT[2] = {0, MOTION_LIMITS};
static const int LAST_LIMIT[2] = {MOTION_LIMITS, LIMITS};

static void assign(V *to, const V *from, int count)
{
    for (int i = 0; i < count; ++i) {
        to[i] = from[i];
    }
}

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

/* Flies states on for up to so many holds of the laws, at first with a look at all that is left of the flight at once. Alive: whose
 * flights have kept the limits of each group and not ended; found: whose have ended, or are seen to keep them for good. */
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
            turned(x, u, after, &least[MOTION_LIMITS]);
        }
        are_kept(least, broken, fine);
        for (int group = THRUSTS; group <= TORQUES; ++group) {
            alive[group] = AND(alive[group], fine[group]);
        }
        assign(x, after, 16);
    }
}

/* Whether the laws' flight keeps the limits of each group that is asked for, and ends. */
static void have_ways(const V x[16], const M broken[LIMITS], const M asked[2], M found[2])
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
    have_ways(after, broken, open, found);
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        found[group] = AND(found[group], kept[group]);
    }
}

/* Of spacecraft whose control is refused the first that is safe on the way to the law's, else that. Returns where it is. */
static M go_towards_law(const V x[16], int group, M refused, const M broken[LIMITS], V control[6])
{
    static const double shares[SHARE_COUNT] = SHARES;
    V law[3];
    V tried[6];
    M open = refused;
    const int first = 3 * group;
    if (group == THRUSTS) {
        backup_thrust(x, &control[3], law);
    } else {
        backup_torque(x, law);
    }
    V proposed[3];
    assign(proposed, &control[first], 3);
    for (int j = 0; j < 3; ++j) {
        control[first + j] = SELECT(refused, law[j], proposed[j]);
    }
    for (int i = 0; (i < SHARE_COUNT) && ANY(open); ++i) {
        M asked[2] = {NO, NO};
        M found[2];
        assign(tried, control, 6);
        for (int j = 0; j < 3; ++j) {
            const V way = proposed[j] + (ALL(shares[i]) * (law[j] - proposed[j]));
            const V low = MIN(proposed[j], law[j]);
            const V high = MAX(proposed[j], law[j]);
            tried[first + j] = MIN(MAX(way, low), high);
        }
        asked[group] = open;
        are_safe(x, tried, broken, asked, found);
        const M taken = AND(open, found[group]);
        for (int j = first; j < (first + 3); ++j) {
            control[j] = SELECT(taken, tried[j], control[j]);
        }
        open = AND(open, NOT(taken));
    }
    return AND(refused, NOT(open));
}

/* Puts what may be applied in the place of a proposed control.
 *
 * broken: limits that are violated already; strange: the state holds no numbers, and nothing can be checked.
 * safe, changed: of thrust and of torque. Torque comes first, since the attitude decides where thrust acts. */
static void commit(const V x[16], const M broken[LIMITS], M strange, V control[6], M safe[2], M changed[2])
{
    const M fit = NOT(strange);
    const M both[2] = {fit, fit};
    are_safe(x, control, broken, both, safe);
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        safe[group] = AND(safe[group], fit);
    }
    for (int group = TORQUES; group >= THRUSTS; --group) {
        changed[group] = AND(fit, NOT(safe[group]));
        if (ANY(changed[group])) {
            safe[group] = OR(safe[group], go_towards_law(x, group, changed[group], broken, control));
            if (group == TORQUES) { /* thrust is looked at again, with the torque that is applied */
                const M asked[2] = {changed[TORQUES], NO};
                M found[2];
                are_safe(x, control, broken, asked, found);
                safe[THRUSTS] = AND(safe[THRUSTS], OR(found[THRUSTS], NOT(changed[TORQUES])));
                safe[THRUSTS] = OR(safe[THRUSTS], AND(found[THRUSTS], changed[TORQUES]));
            }
        }
    }
    /* both groups follow their laws where that is safe and no other control is: it was flown a call ago */
    const M open = AND(OR(changed[THRUSTS], changed[TORQUES]), NOT(AND(safe[THRUSTS], safe[TORQUES])));
    if (ANY(open)) {
        V law[6];
        M found[2];
        const M asked[2] = {open, open};
        have_ways(x, broken, asked, found);
        backup_torque(x, &law[3]);
        backup_thrust(x, &law[3], law);
        const M follow = AND(open, AND(found[THRUSTS], found[TORQUES]));
        for (int j = 0; j < 6; ++j) {
            control[j] = SELECT(follow, law[j], control[j]);
        }
        for (int group = THRUSTS; group <= TORQUES; ++group) {
            safe[group] = OR(safe[group], follow);
            changed[group] = OR(changed[group], follow);
        }
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

/* A limit that is kept does not yield: what its row lacked was the row's alone. */
static void nothing_yields(const M broken[LIMITS], const M safe[2], const M changed[2], V slack[CONSTRAINTS],
                           V program_status[2])
{
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        V left = ALL(0.0);
        for (int k = 0; k < CONSTRAINTS; ++k) {
            if (GROUP_OF[k] == group) {
                if (k < KEPT_LIMITS) {
                    const M is_kept = AND(safe[group], NOT(broken[(k < LIMITS) ? k : (LIMITS - 1)]));
                    slack[k] = SELECT(is_kept, ALL(0.0), slack[k]);
                }
                left = MAX(left, slack[k]);
            }
        }
        const V status = SELECT(changed[group], MAX(program_status[group], ALL(1.0)), program_status[group]);
        const M held = AND(AND(safe[group], NOT(left > SLACK_ROUNDED)), status == 2.0);
        program_status[group] = SELECT(held, ALL(1.0), status);
    }
}

/* Whether all limits are kept, now and on the flight. */
static M is_verified(const M broken[LIMITS], const M safe[2])
{
    M found = AND(safe[THRUSTS], safe[TORQUES]);
    for (int k = 0; k < LIMITS; ++k) {
        found = AND(found, NOT(broken[k]));
    }
    return found;
}
