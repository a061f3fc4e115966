/* What is known of W spacecraft of a batch. */
struct block {
    V numbers[6 + 4 * CONSTRAINTS]; /* control, slack, h, uncertainty, tightened */
    V program_status[2];
    M active[CONSTRAINTS];
    M open[1]; /* lanes that are left to the filter for one spacecraft */
};

static int any(M m)
{
    int found = 0;
    for (int lane = 0; lane < W; ++lane) {
        found |= m[lane] != 0;
    }
    return found;
}

