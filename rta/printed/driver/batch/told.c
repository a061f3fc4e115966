/* The checks of a filter that is told of bounds, of W spacecraft at a time. */

#if TURN || HELD_CALLS > 0
/* Lanes whose control is refused, or in which a limit of the user's own yields; elsewhere what the rows of a group lacked of
 * limits first to last is the rows' alone. */
static M refused_or_yielding(M refused, int group, int first, int last, V numbers[6 + 2 * CONSTRAINTS], V program_status[2])
{
    M found = refused;
    for (int k = KEPT_LIMITS; k < CONSTRAINTS; ++k) {
        found |= numbers[6 + k] > 0.0;
    }
    for (int k = first; k < last; ++k) {
        numbers[6 + k] = SELECT(found, numbers[6 + k], ALL(0.0));
    }
    program_status[group] = SELECT(found, program_status[group], MIN(program_status[group], ALL(1.0)));
    return found;
}
#endif

/* Lanes whose torque is not seen to keep the attitude's limits and to leave a way to rest, or in which a limit of the
 * user's own yields; elsewhere what the rows of torque lacked was the rows' alone. */
static M check_turn(const V x[16], const V error_bound[4], V numbers[6 + 2 * CONSTRAINTS], V program_status[2])
{
#if TURN
    V least[1];
    turn_verified(x, numbers, error_bound, least);
    return refused_or_yielding(~(least[0] >= 0.0), 1, MOTION_LIMITS, KEPT_LIMITS, numbers, program_status);
#else
    (void)x;
    (void)error_bound;
    (void)numbers;
    (void)program_status;
    return NO;
#endif
}

/* Lanes whose thrust is not seen to keep the limits of motion and to leave a way into the haven, likewise. */
static M check_thrust(const V x[16], const V error_bound[4], V numbers[6 + 2 * CONSTRAINTS], V program_status[2])
{
#if HELD_CALLS > 0
    V ends[HELD_CALLS][16];
    V bounds[HELD_CALLS][4];
    V grown[HELD_CALLS + 1];
    V widest[4];
    V late[1];
    V least[1];
    M found = NO;
    const V *now = x;
    const V *bound = error_bound;
    grown[0] = bound[1];
    for (int call = 0; call < HELD_CALLS; ++call) {
        homing_look(now, numbers, bound, ends[call], bounds[call], least);
        found |= ~(least[0] >= 0.0);
        now = ends[call];
        bound = bounds[call];
        grown[call + 1] = bound[1];
    }
    for (int call = 0; call < HELD_CALLS; ++call) { /* all at once, see homing.c */
        const V *middle = ends[(HELD_CALLS - 1) / 2];
        V shifted[4];
        memcpy(shifted, bounds[call], sizeof shifted);
        for (int k = 0; k < 2; ++k) {
            V sum = ALL(0.0);
            for (int i = 3 * k; i < 3 * k + 3; ++i) {
                sum += (ends[call][i] - middle[i]) * (ends[call][i] - middle[i]);
            }
            shifted[k] += SQRT(sum);
        }
        const V since = bounds[call][1] - ((call + 1 >= LATENCY) ? grown[call + 1 - LATENCY] : ALL(0.0));
        late[0] = call ? MAX(late[0], since) : since;
        for (int i = 0; i < 4; ++i) {
            widest[i] = call ? MAX(widest[i], shifted[i]) : shifted[i];
        }
    }
    homing_way(ends[(HELD_CALLS - 1) / 2], widest, late, least);
    return refused_or_yielding(found | ~(least[0] >= 0.0), 0, 0, MOTION_LIMITS, numbers, program_status);
#else
    (void)x;
    (void)error_bound;
    (void)numbers;
    (void)program_status;
    return NO;
#endif
}
