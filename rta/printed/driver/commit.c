/* Propose, check, commit: a control is applied if a backup trajectory keeps all limits after it; else the nearest such
 * between it and the laws' control; at last that. The backup trajectory is that of flight.c or of robust_check.c.
 *
 * The same text checks one spacecraft and vectors of them: V is a number, M a truth value, of each. y: the state and, with
 * error bounds, by how much further than measured it may be off. */

enum { THRUSTS = 0, TORQUES = 1 };

static void assign(V *to, const V *from, int count)
{
    for (int i = 0; i < count; ++i) {
        to[i] = from[i];
    }
}

/* Whether a spacecraft can be in a state: of numbers up to LARGEST, with a unit quaternion, above absolute zero. */
static M is_state(const V y[SEEN])
{
    V room[2];
    M found = YES;
    for (int i = 0; i < SEEN; ++i) {
        found = AND(found, FABS(y[i]) <= LARGEST);
    }
    state_room(y, room);
    return AND(found, AND(room[0] > 0.0, room[1] > 0.0));
}

/* Which limits are broken already, and not asked for, and whether controls of each group can be checked. */
static void are_fit(const V y[SEEN], const V h[CONSTRAINTS], M broken[LIMITS], M fit[2]);

/* Whether a control keeps the limits of each group that is asked for while it is held, and its backup trajectory does. */
static void are_safe(const V y[SEEN], const V control[6], const M broken[LIMITS], const M asked[2], M found[2]);

/* Has both groups follow their laws where that is known to be safe. Returns where it is. */
static M follow(const V y[SEEN], M open, const M broken[LIMITS], V control[6]);

/* Of spacecraft whose control is refused the first safe one between it and the law's, else that. Returns where it is. */
static M go_towards_law(const V y[SEEN], int group, M refused, const M broken[LIMITS], V control[6])
{
    static const double shares[SHARE_COUNT] = SHARES;
    V law[3];
    V proposed[3];
    V tried[6];
    M open = refused;
    const int first = 3 * group;
    if (group == THRUSTS) {
        backup_thrust(y, &control[3], law);
    } else {
        backup_torque(y, law);
    }
    assign(proposed, &control[first], 3);
    assign(tried, control, 6);
    assign(&tried[first], law, 3);
    round_thrust(tried);
    for (int j = first; j < (first + 3); ++j) {
        control[j] = SELECT(refused, tried[j], control[j]);
    }
    for (int i = 0; (i < SHARE_COUNT) && ANY(open); ++i) {
        M asked[2] = {NO, NO};
        M found[2];
        assign(tried, control, 6);
        for (int j = 0; j < 3; ++j) {
            const V between = proposed[j] + (ALL(shares[i]) * (law[j] - proposed[j]));
            const V low = MIN(proposed[j], law[j]);
            const V high = MAX(proposed[j], law[j]);
            tried[first + j] = MIN(MAX(between, low), high);
        }
        round_thrust(tried);
        asked[group] = open;
        are_safe(y, tried, broken, asked, found);
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
 * broken, fit: see are_fit; safe, changed: of thrust and of torque. Torque comes first, since the attitude decides where
 * thrust acts. */
static void commit(const V y[SEEN], const M broken[LIMITS], const M fit[2], V control[6], M safe[2], M changed[2])
{
    are_safe(y, control, broken, fit, safe);
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        safe[group] = AND(safe[group], fit[group]);
    }
    for (int group = TORQUES; group >= THRUSTS; --group) {
        changed[group] = AND(fit[group], NOT(safe[group]));
        if (ANY(changed[group])) {
            safe[group] = OR(safe[group], go_towards_law(y, group, changed[group], broken, control));
            if (group == TORQUES) { /* thrust is looked at again, with the torque that is applied */
                const M asked[2] = {AND(changed[TORQUES], fit[THRUSTS]), NO};
                M found[2];
                are_safe(y, control, broken, asked, found);
                safe[THRUSTS] = AND(safe[THRUSTS], NOT(changed[TORQUES]));
                safe[THRUSTS] = OR(safe[THRUSTS], AND(found[THRUSTS], asked[THRUSTS]));
            }
        }
    }
    /* both follow their laws where no other control is safe and that is */
    const M open = AND(OR(changed[THRUSTS], changed[TORQUES]), NOT(AND(safe[THRUSTS], safe[TORQUES])));
    if (ANY(open)) {
        const M followed = follow(y, open, broken, control);
        for (int group = THRUSTS; group <= TORQUES; ++group) {
            safe[group] = OR(safe[group], followed);
            changed[group] = OR(changed[group], followed);
        }
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
        const M kept = AND(AND(safe[group], NOT(left > SLACK_ROUNDED)), status == 2.0);
        program_status[group] = SELECT(kept, ALL(1.0), status);
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
