/* One group's controls of W spacecraft: rows at controls near the desired ones, an attempt, rows at its answer. */
static void group_correct(const V x[16], const V error_bound[4], const V left[6], const V wish[6], V control[6],
                          struct block *block)
{
    V nearby[6];
    V answer[6];
    V psi[GROUP_ROWS];
    V a[3 * GROUP_ROWS];
    V b[GROUP_ROWS];
    V b_bare[GROUP_ROWS];
    V waived[GROUP_ROWS];
    V h[GROUP_OWN];
    V tightening[GROUP_ROWS];
    V length[GROUP_ROWS];
    V lowest[1];
    V slack[GROUP_OWN];
    V value[GROUP_OWN];
    V uncertainty[GROUP_OWN];
    V tightened[GROUP_OWN];
    V lacking[GROUP_OWN]; /* by desired controls, what rows beyond limits waive */
    M active[GROUP_OWN];
    M safe[1];
    M solved[1];
    M held[1] = {YES};
    for (int k = 0; k < GROUP_OWN; ++k) {
        active[k] = NO;
        slack[k] = ALL(0.0);
    }
    group_near(x, control, nearby);
    group_rows(x, nearby, error_bound, left, psi, a, b, b_bare, waived, h, tightening, length, lowest);
    group_report(psi, a, b, b_bare, waived, h, tightening, length, lowest, control, left, value, uncertainty, tightened,
                 lacking);
    group_attempt(psi, a, b, b_bare, waived, h, tightening, length, lowest, wish, control, nearby, left, answer, safe,
                  solved);
    if (any(~safe[0])) {
        group_rows(x, answer, error_bound, left, psi, a, b, b_bare, waived, h, tightening, length, lowest);
        group_judge(psi, a, b, b_bare, waived, h, tightening, length, lowest, answer, left, held, active, slack);
    }
    for (int j = 0; j < 6; ++j) {
        control[j] = SELECT(safe[0], control[j], answer[j]);
    }
    V status = SELECT(safe[0], block->program_status[GROUP_INDEX], ALL(1.0));
    for (int k = 0; k < GROUP_OWN; ++k) {
        const int at = GROUP_PLACE[k];
        const V own = SELECT(safe[0], lacking[k], slack[k]);
        status = SELECT(own > 0.0, MAX(status, ALL(2.0)), status);
        block->numbers[6 + at] = own;
        block->numbers[6 + CONSTRAINTS + at] = value[k];
        block->numbers[6 + 2 * CONSTRAINTS + at] = uncertainty[k];
        block->numbers[6 + 3 * CONSTRAINTS + at] = tightened[k];
        block->active[at] = active[k] & ~safe[0];
    }
    block->program_status[GROUP_INDEX] = status;
    block->open[0] |= ~(safe[0] | (GROUP_COARSE ? NO : (solved[0] & held[0])));
}
