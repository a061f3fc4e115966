/* What is not decided at once, of the check of the model. */
struct pending {
    struct waiting refused;
    struct flights flights; /* after controls that keep all limits while they are held */
    struct waiting hopeful; /* those */
};

/* Lanes whose controls are not seen at once to keep all limits and to begin a flight that does; where they are nothing
 * yields. Numbers: controls, slack, h. After: the states at the end of the hold; hopes: lanes in which that is kept. */
static M are_unsure(const V y[SEEN], V numbers[6 + 2 * CONSTRAINTS], V program_status[2], V after[16], M *hopes)
{
    const M unchanged[2] = {NO, NO};
    V least[LIMITS];
    M broken[LIMITS];
    M kept[2];
    M later[2];
    are_broken(&numbers[6 + CONSTRAINTS], broken);
    flown(y, numbers, after, least);
    are_kept(least, broken, kept);
    const M both[2] = {kept[0] & kept[1], kept[0] & kept[1]};
    *hopes = is_state(y) & is_verified(broken, both);
    at_once(after, least);
    are_kept(least, broken, later);
    const M sure = *hopes & later[0] & later[1];
    const M seen[2] = {sure, sure};
    nothing_yields(broken, seen, unchanged, &numbers[6], program_status);
    return ~sure;
}

/* Flies on until there is room, or `all` flights have ended: stores controls whose flights keep all limits, and has the
 * others wait. */
static void fly_hopeful(struct pending *pending, int all, void *const *out, const long *out_step)
{
    struct flights *const flights = &pending->flights;
    struct waiting *const these = &pending->hopeful;
    while (flights->count == W || (all && flights->count > 0)) {
        const M unchanged[2] = {NO, NO};
        fly_all(flights);
        const M other = differ(these->desired, these->control);
        const M both = flights->found[0] & flights->found[1];
        const M seen[2] = {both, both};
        nothing_yields(flights->broken, seen, unchanged, these->slack, these->program_status);
        for (int lane = flights->count - 1; lane >= 0; --lane) {
            if (has_ended(flights, lane)) {
                if (both[lane]) {
                    store_waiting(these, lane, other[lane] != 0, 1, 0, out, out_step);
                } else {
                    wait_for_a_check(&pending->refused, these, lane, out, out_step);
                }
                put_waiting(these, lane, these, flights->count - 1);
                end_flight(flights, lane);
            }
        }
    }
}

/* Of a block begins the flights of hopeful lanes, and has the other ones that are unsure wait. */
static void look_closely(M unsure, M hopes, const V after[16], const struct waiting *block, long lanes,
                         struct pending *pending, void *const *out, const long *out_step)
{
    const M none[LIMITS] = {NO};
    const M both[2] = {YES, YES};
    for (int lane = 0; lane < W && lane < lanes; ++lane) {
        if (unsure[lane] & hopes[lane]) {
            put_waiting(&pending->hopeful, pending->flights.count, block, lane);
            begin_flight(&pending->flights, after, none, both, lane, block->column[lane]);
            fly_hopeful(pending, 0, out, out_step);
        } else if (unsure[lane]) {
            wait_for_a_check(&pending->refused, block, lane, out, out_step);
        }
    }
}

/* Decides all that is left. */
static void finish(struct pending *pending, void *const *out, const long *out_step)
{
    fly_hopeful(pending, 1, out, out_step);
    check_waiting(&pending->refused, out, out_step);
}
