/* From rows to programs, and from their solutions to what is reported. */

/* The rows a u + b >= 0 of a group in N or N m, as the printed functions compute them. */
struct rows {
    double psi[GROUP_ROWS_MAX];
    double a[GROUP_ROWS_MAX * 3];
    double b[GROUP_ROWS_MAX];
    double b_no_margin[GROUP_ROWS_MAX]; /* without margin */
    double relaxation[GROUP_ROWS_MAX]; /* by how much that asks for less than the condition does, beyond a limit */
    double h[GROUP_CONSTRAINTS_MAX];
    double length[GROUP_ROWS_MAX]; /* per actuator limit */
    double lowest[1];              /* scaled left-hand side at the control; negative or NaN: to be corrected */
};

/* The same in units of the actuators' limits, of unit length. */
struct scaled {
    double a[GROUP_ROWS_MAX][3];
    double b[GROUP_ROWS_MAX];
    double b_no_margin[GROUP_ROWS_MAX];
    double relaxation[GROUP_ROWS_MAX]; /* not scaled, as length */
    double length[GROUP_ROWS_MAX];
};

/* `limit`: what is there of each actuator, in N or N m. */
static void scale(int group, const struct rows *rows, const double limit[3], struct scaled *scaled)
{
    for (int i = 0; i < ROWS[group]; ++i) {
        const double length = rows->length[i];
        scaled->b[i] = clip(rows->b[i] / length, HOPELESS, REDUNDANT);
        scaled->b_no_margin[i] = clip(rows->b_no_margin[i] / length, HOPELESS, REDUNDANT);
        scaled->relaxation[i] = rows->relaxation[i];
        scaled->length[i] = length;
        for (int j = 0; j < 3; ++j) {
            scaled->a[i][j] = rows->a[(3 * i) + j] * (limit[j] / length);
        }
    }
}

static void program_of(int group, const struct scaled *scaled, const double desired[3], struct program *program)
{
    begin_program(program, desired);
    for (int i = 0; i < ROWS[group]; ++i) {
        copy(program->a[program->rows], scaled->a[i], 3);
        program->b[program->rows] = scaled->b[i];
        program->b_no_margin[program->rows] = scaled->b_no_margin[i];
        program->weight[program->rows] = WEIGHT[group][i];
        program->rows += 1;
    }
}

/* Says by constraint whether a row binds a group's control u, in units of the limits, that was corrected, and how far one
 * falls short: where rows yielded, and where a row beyond its limit asks for less than the condition does. The status is
 * SLACK at least then. */
static void say(int group, const struct scaled *scaled, const double u[3], int is_corrected,
                struct safety_filter_output *out)
{
    double reached[GROUP_ROWS_MAX];
    double least = INFINITY;
    const int status = out->program_status[group];
    for (int i = 0; i < ROWS[group]; ++i) {
        reached[i] = dot(scaled->a[i], u, 3);
        least = smaller(least, reached[i] + scaled->b[i]);
    }
    const double *side = (least >= -FEASIBLE) ? scaled->b : scaled->b_no_margin;
    for (int i = 0; i < ROWS[group]; ++i) {
        const int place = PLACE[group][CONSTRAINT_OF_ROW[group][i]];
        const double lack = -(reached[i] + scaled->b_no_margin[i]) * scaled->length[i];
        if ((is_corrected != 0) && ((reached[i] + side[i]) <= FEASIBLE)) {
            out->active[place] = 1;
        }
        if (status >= SLACK) {
            out->slack[place] = larger(out->slack[place], lack);
        }
        if ((scaled->relaxation[i] > 0.0) && ((lack + scaled->relaxation[i]) > (FEASIBLE * scaled->length[i]))) {
            out->slack[place] = larger(out->slack[place], lack + scaled->relaxation[i]);
        }
        if ((out->slack[place] > 0.0) && (status < SLACK)) {
            out->program_status[group] = SLACK;
        }
    }
}
