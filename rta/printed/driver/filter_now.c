/* The filter where rows are of the rate of now: at most one program for thrust, and one for torque. */

static void rows_of(int group, const double x[16], const double control[6], struct rows *r)
{
    if (group == THRUST) {
        thrust_rows(x, control, r->psi, r->a, r->b, r->b_bare, r->waived, r->h, r->length, r->lowest);
    } else {
        torque_rows(x, control, r->psi, r->a, r->b, r->b_bare, r->waived, r->h, r->length, r->lowest);
    }
}

static void correct(int group, const struct rows *rows, const double limit[3], const double wish[6],
                    double control[6], struct safety_filter_output *out)
{
    static const double nothing[GROUP_ROWS_MAX] = {0.0};
    double desired[3];
    struct scaled scaled;
    struct program program;
    struct answer answer;
    struct found found;
    for (int j = 0; j < 3; ++j) {
        desired[j] = wish[(3 * group) + j] / LIMIT[group];
    }
    scale(group, rows, limit, &scaled);
    begin_program(&program, desired);
    append(&program, group, &scaled, nothing, 1);
    solve(&program, &answer);
    copy(found.control, answer.control, 3);
    found.status = answer.status;
    found.residual = answer.residual;
    say(group, &scaled, &found);
    apply(group, &found, control, out);
}

void safety_filter(const struct safety_filter_input *in, struct safety_filter_output *out)
{
    double x[16];
    double wish[6];
    double control[6];
    struct rows rows;
    begin(in, x, wish, control, out);
    for (int group = THRUST; group <= TORQUE; ++group) {
        const double limit[3] = {LIMIT[group], LIMIT[group], LIMIT[group]};
        rows_of(group, x, control, &rows);
        for (int k = 0; k < CONSTRAINTS_OF[group]; ++k) {
            out->h[PLACE[group][k]] = rows.h[k];
        }
        if (!(rows.lowest[0] >= 0.0)) { /* NaN must not pass */
            correct(group, &rows, limit, wish, control, out);
        } else {
            leave_as_is(group, &rows, limit, control, out);
        }
    }
#if BACKUP
    commit(x, control, out);
#endif
    end(in, control, out);
}
