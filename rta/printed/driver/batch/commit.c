/* Lanes whose controls are not seen at a glance to keep all limits and to leave a way to rest, whose rates are beyond
 * theirs, or in which a limit of the user's own yields. Numbers: controls, slack, h. */
static M unsure(const V x[16], const V numbers[6 + 2 * CONSTRAINTS])
{
#if BACKUP
    V thrust[1];
    V torque[1];
    M found = NO;
    thrust_glance(x, numbers, thrust);
    torque_sight(x, numbers, torque);
    if (any(~(torque[0] >= 0.0))) {
        torque_glance(x, numbers, torque);
    }
    for (int k = MOTION_LIMITS + ATTITUDE_LIMITS; k < KEPT_LIMITS; ++k) {
        found |= ~(numbers[6 + CONSTRAINTS + k] >= -RATES_ROUNDED);
    }
    for (int k = KEPT_LIMITS; k < CONSTRAINTS; ++k) {
        found |= numbers[6 + k] > 0.0;
    }
    return found | ~((thrust[0] >= 0.0) & (torque[0] >= 0.0));
#else
    (void)x;
    (void)numbers;
    return NO;
#endif
}

/* Where controls are safe no limit yields: what its rows lacked was the rows' alone. */
static void nothing_yields(M unseen, V program_status[2], V slack[CONSTRAINTS])
{
#if BACKUP
    for (int group = 0; group < 2; ++group) {
        program_status[group] = SELECT(unseen, program_status[group], MIN(program_status[group], ALL(1.0)));
    }
    for (int k = 0; k < CONSTRAINTS; ++k) {
        slack[k] = SELECT(unseen, slack[k], ALL(0.0));
    }
#else
    (void)unseen;
    (void)program_status;
    (void)slack;
#endif
}
