/* Thrusters that give some values only: multiples of a quantum, or nothing below the least. */

/* What the thrusters give where so much is asked for, in N. */
static double given(double thrust)
{
    double gives = (fabs(thrust) < MINIMUM_THRUST) ? 0.0 : thrust;
    if (THRUST_QUANTUM > 0.0) {
        gives = clip(THRUST_QUANTUM * rint(thrust / THRUST_QUANTUM), -LARGEST_THRUST, LARGEST_THRUST);
    }
    return gives;
}

/* What they give next to that on either side. */
static void neighbours(double thrust, double *low, double *high)
{
    if (THRUST_QUANTUM > 0.0) {
        const double number = floor(thrust / THRUST_QUANTUM);
        *low = clip(THRUST_QUANTUM * number, -LARGEST_THRUST, LARGEST_THRUST);
        *high = clip(THRUST_QUANTUM * (number + 1.0), -LARGEST_THRUST, LARGEST_THRUST);
    } else if (fabs(thrust) < MINIMUM_THRUST) {
        const double least = fmin(MINIMUM_THRUST * (1.0 + ABOVE_LEAST), LIMIT[THRUST]);
        *low = 0.0;
        *high = (thrust > 0.0) ? least : ((thrust < 0.0) ? -least : 0.0);
    } else {
        *low = thrust;
        *high = thrust;
    }
}

/* Takes the best of the controls that have one of so many values on each axis. */
static void try_corners(const struct situation *where, double values[3][3], int count, struct best *best)
{
    for (int i = 0; i < count; ++i) {
        for (int j = 0; j < count; ++j) {
            for (int k = 0; k < count; ++k) {
                const double u[3] = {values[0][i], values[1][j], values[2][k]};
                try_control(where, u, best);
            }
        }
    }
}

/* Takes the best of what the thrusters give next to a control. */
static void try_neighbours(const struct situation *where, const double u[3], struct best *best)
{
    double values[3][3];
    for (int j = 0; j < 3; ++j) {
        neighbours(u[j] * LIMIT[THRUST], &values[j][0], &values[j][1]);
        values[j][0] /= LIMIT[THRUST];
        values[j][1] /= LIMIT[THRUST];
    }
    try_corners(where, values, 2, best);
}

/* Solves the program again, with rows that hold however its solution is rounded, a u + b >= sum_i |a_i| gap / 2. */
static void with_cushion(const struct situation *where, const double u[3], double control[3])
{
    struct scaled tangents;
    struct program program;
    struct answer answer;
    double cushion[GROUP_ROWS_MAX] = {0.0};
    tangents_at(where, u, &tangents);
    for (int i = 0; i < ROWS[THRUST]; ++i) {
        const double *a = tangents.a[i];
        cushion[i] = (fabs(a[0]) + fabs(a[1]) + fabs(a[2])) * THRUST_GAP / 2.0 / LIMIT[THRUST];
    }
    begin_program(&program, where->desired);
    append(&program, THRUST, &tangents, cushion, 1);
    solve(&program, &answer);
    copy(control, answer.control, 3);
}

/* Takes the best of what the thrusters give next to the control so far. Where none of these holds the rows, a program
 * with a cushion is solved; where not even that helps, all or nothing of each axis is tried. */
static void settle_for_what_is_given(const struct situation *where, struct best *best)
{
    double before[3];
    double all_or_nothing[3][3];
    copy(before, best->found.control, 3);
    best->score = -INFINITY;
    for (int j = 0; j < 3; ++j) {
        best->found.control[j] = given(before[j] * LIMIT[THRUST]) / LIMIT[THRUST];
        all_or_nothing[j][0] = -LARGEST_THRUST / LIMIT[THRUST];
        all_or_nothing[j][1] = 0.0;
        all_or_nothing[j][2] = LARGEST_THRUST / LIMIT[THRUST];
    }
    if (best->found.status < UNSOLVED) {
        try_neighbours(where, before, best);
    }
    if (best->found.status == SLACK) {
        double u[3];
        with_cushion(where, best->found.control, u);
        try_neighbours(where, u, best);
    }
    if (best->found.status == SLACK) {
        try_corners(where, all_or_nothing, 3, best);
    }
}
