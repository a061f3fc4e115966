/* Lanes whose controls are not seen at once to be safe; elsewhere nothing yields. Numbers: controls, slack, h. */
static M are_unsure(const V y[SEEN], V numbers[6 + 2 * CONSTRAINTS], V program_status[2])
{
    const M unchanged[2] = {NO, NO};
    const M both[2] = {YES, YES};
    const M none[LIMITS] = {NO};
    M safe[2];
    are_seen_safe(y, numbers, both, 0, safe);
    const M unsure = ~is_state(y) | ((HELD_CALLS > 0) ? ~safe[THRUSTS] : NO) | (ATTITUDE_CHECKED ? ~safe[TORQUES] : NO);
    for (int group = THRUSTS; group <= TORQUES; ++group) {
        safe[group] &= ~unsure;
    }
    nothing_yields(none, safe, unchanged, &numbers[6], program_status);
    return unsure;
}
