#if BACKUP
static int any_of(M m)
{
    int found = 0;
    for (int lane = 0; lane < W; ++lane) {
        found |= m[lane] != 0;
    }
    return found;
}
#endif

/* Lanes whose controls are not seen at a glance to keep all limits and to leave a way to rest. */
static M unsure(const V x[16], const V control[6])
{
#if BACKUP
    V thrust[1];
    V torque[1];
    thrust_glance(x, control, thrust);
    torque_sight(x, control, torque);
    if (any_of(~(torque[0] >= 0.0))) {
        torque_glance(x, control, torque);
    }
    return ~((thrust[0] >= 0.0) & (torque[0] >= 0.0));
#else
    (void)x;
    (void)control;
    return NO;
#endif
}

/* Where controls are safe no limit that a way keeps yields: what its rows lacked was the rows' alone. */
static void nothing_yields(M unseen, V program_status[2], V slack[CONSTRAINTS])
{
#if BACKUP
    V left = ALL(0.0);
    for (int k = 0; k < CONSTRAINTS; ++k) {
        slack[k] = (k < KEPT_LIMITS) ? SELECT(unseen, slack[k], ALL(0.0)) : slack[k];
        left = MAX(left, slack[k]);
    }
    for (int group = 0; group < 2; ++group) {
        const M lowered = ~unseen & (left <= 0.0);
        program_status[group] = SELECT(lowered, MIN(program_status[group], ALL(1.0)), program_status[group]);
    }
#else
    (void)unseen;
    (void)program_status;
    (void)slack;
#endif
}
