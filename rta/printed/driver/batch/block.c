/* What is known of W spacecraft of a batch. */
struct block {
    V numbers[6 + 4 * CONSTRAINTS]; /* control, slack, h, uncertainty, tightened */
    V program_status[2];
    M active[CONSTRAINTS];
    M open[1]; /* lanes that are left to the filter for one spacecraft */
};
