/*
 * The search for a control that holds the rows themselves, not only their tangents at the desired one.
 *
 * What is convex lies within its tangents, so a solution may break it. Then the tangents there are added, and the
 * program is solved again (Kelley 1960). If that ends without success the search begins again at no control, and the
 * solution goes back towards it: from there to the solution a concave psi is at least its chord. Where thrusters give
 * some values only, their neighbours of the solution are tried. What is still broken is counted as slack.
 */

/* What the rows of a group depend on, but for the group's own control. */
struct situation {
    int group;
    double x[16];
    double control[6];
    double error_bound[4];  /* by how far the state is off beyond its measurement: m, m/s, rad, rad/s */
    double left[6];
    double desired[3]; /* the group's control in units of its actuators' limits, beyond these, too */
    double size;       /* its largest number, at least 1, by which distances are measured */
    double limit[3];   /* N or N m, what is there of its actuators */
};

/* The best control so far. */
struct best {
    struct found found;
    double score; /* greater the better it is; -INFINITY before there is one */
};

/* What is known of a control that was tried. */
struct tried {
    struct scaled tangents;
    double within[GROUP_ROWS_MAX]; /* how far within the rows it is, in their units */
    int holds;                     /* 1 where it holds the rows */
    int is_better;                 /* 1 where it clearly was better than those before */
};

static void rows_of(int group, const double x[16], const double control[6], const double error_bound[4],
                    const double left[6], struct rows *r)
{
    if (group == THRUST) {
        thrust_rows(x, control, error_bound, left, r->psi, r->a, r->b, r->b_bare, r->waived, r->h, r->tightening, r->length,
                    r->lowest);
    } else {
        torque_rows(x, control, error_bound, left, r->psi, r->a, r->b, r->b_bare, r->waived, r->h, r->tightening, r->length,
                    r->lowest);
    }
}

static void tangents_at(const struct situation *where, const double u[3], struct scaled *tangents)
{
    struct rows rows;
    double control[6];
    copy(control, where->control, 6);
    for (int j = 0; j < 3; ++j) {
        control[(3 * where->group) + j] = u[j] * LIMIT[where->group];
    }
    rows_of(where->group, where->x, control, where->error_bound, where->left, &rows);
    scale(where->group, &rows, where->limit, tangents);
}

/* The highest weight of the group's rows below another, 0 if there is none. */
static double lower_class(int group, double weight)
{
    double lower = 0.0;
    for (int i = 0; i < ROWS[group]; ++i) {
        if ((WEIGHT[group][i] < weight) && (WEIGHT[group][i] > lower)) {
            lower = WEIGHT[group][i];
        }
    }
    return lower;
}

/* What a control lacks that is within the rows by so much, each class far more than those below it. */
static double shortage(int group, const double within[GROUP_ROWS_MAX])
{
    double lack = 0.0;
    double weight = INFINITY;
    for (int k = 0; (k <= CLASSES_MAX) && (weight > 0.0); ++k) {
        const double lower = lower_class(group, weight);
        double least = INFINITY;
        for (int i = 0; i < ROWS[group]; ++i) {
            if ((WEIGHT[group][i] <= weight) && (WEIGHT[group][i] > lower)) {
                least = smaller(least, within[i]);
            }
        }
        lack = (ABOVE * lack) + larger(-TOLERATED - least, 0.0);
        weight = lower;
    }
    return lack;
}

/* Takes a control if it is better: the nearest of those that hold the rows, else the least short. */
static void take(const struct situation *where, const struct answer *answer, struct best *best, struct tried *tried)
{
    const int group = where->group;
    const int is_first = isinf(best->score) ? 1 : 0;
    const int is_solved = (answer->status < UNSOLVED) ? 1 : 0;
    double within[GROUP_ROWS_MAX];
    double least = INFINITY;
    double distance = 0.0;
    tangents_at(where, answer->control, &tried->tangents);
    for (int i = 0; i < ROWS[group]; ++i) {
        within[i] = dot(tried->tangents.a[i], answer->control, 3) + tried->tangents.b_bare[i];
        tried->within[i] = within[i] * tried->tangents.length[i];
        least = smaller(least, within[i]);
    }
    for (int j = 0; j < 3; ++j) {
        const double off = (answer->control[j] - where->desired[j]) / where->size;
        distance += off * off;
    }
    tried->holds = (least >= -TOLERATED) ? 1 : 0;
    double score = FARTHEST - distance;
    if (tried->holds == 0) {
        score = -shortage(group, within);
    }
    score = isnan(score) ? -INFINITY : score;
    const double clearly = TOLERATED * fmax(fabs(best->score), 1.0);
    tried->is_better = ((is_first != 0) || ((score - best->score) > clearly)) ? 1 : 0;
    if ((is_first != 0) || ((is_solved != 0) && (score > best->score))) {
        best->score = score;
        copy(best->found.control, answer->control, 3);
        best->found.residual = answer->residual;
        best->found.status = (is_solved == 0) ? UNSOLVED : ((tried->holds != 0) ? HARD : SLACK);
        say(group, &tried->tangents, &best->found);
    }
}

/* A control that no program asks for. */
static void try_control(const struct situation *where, const double u[3], struct best *best)
{
    struct tried tried;
    struct answer answer = {.status = HARD, .residual = 0.0};
    copy(answer.control, u, 3);
    take(where, &answer, best, &tried);
}

static void append_inset(struct program *p, int group, const struct scaled *tangents, int copies)
{
    double inset[GROUP_ROWS_MAX];
    for (int i = 0; i < GROUP_ROWS_MAX; ++i) {
        inset[i] = INSET;
    }
    append(p, group, tangents, inset, copies);
}

/* Takes the least control that holds the rows, if tangents near no control lead to it. Far away they lose what psi
 * hangs between two moments there, and may exclude every small control. */
static void from_rest(const struct situation *where, struct program *program, struct best *best)
{
    static const double rest[3] = {0.0};
    struct answer answer;
    struct tried tried;
    int is_open = 1;
    tangents_at(where, rest, &tried.tangents);
    for (int pass = 0; (pass < PASSES_AT_REST) && (is_open != 0); ++pass) {
        begin_program(program, rest);
        append_inset(program, where->group, &tried.tangents, 1);
        solve(program, &answer);
        take(where, &answer, best, &tried);
        is_open = ((tried.holds == 0) && (answer.status < UNSOLVED)) ? 1 : 0;
    }
}

/* Where no control of the group's own holds the rows, takes as much of u as does, too. */
static void go_back(const struct situation *where, const double u[3], const double within[GROUP_ROWS_MAX],
                    struct best *best)
{
    static const double rest[3] = {0.0};
    struct scaled tangents;
    double back[3];
    double share = INFINITY;
    double least = INFINITY;
    tangents_at(where, rest, &tangents);
    for (int i = 0; i < ROWS[where->group]; ++i) {
        const double at_rest = tangents.b_bare[i] * tangents.length[i];
        share = smaller(share, (within[i] < 0.0) ? (at_rest / (at_rest - within[i])) : 1.0);
        least = smaller(least, at_rest);
    }
    for (int j = 0; j < 3; ++j) {
        back[j] = (least >= 0.0) ? (share * u[j]) : u[j];
    }
    try_control(where, back, best);
}

/* Adds the tangents where a control was tried to a program's; where rows yielded these alone, since the others left no
 * control, but counted as often as there were rows before. */
static void add_tangents(struct program *p, const struct situation *where, int pass, int anew,
                         const struct scaled *tangents)
{
    int copies = 1;
    if (anew != 0) {
        begin_program(p, where->desired);
        copies = pass + 2;
    }
    append_inset(p, where->group, tangents, copies);
}

/* From the rows at a control near the desired one. */
static void search(const struct situation *where, const struct scaled *near_by, struct best *best)
{
    struct program program;
    struct answer answer;
    struct tried tried;
    int in_vain = 0;
    int is_open = 1;
    int goes_on = 1;
    begin_program(&program, where->desired);
    append_inset(&program, where->group, near_by, 1);
    for (int pass = 0; (pass < PASSES) && (goes_on != 0); ++pass) {
        solve(&program, &answer);
        take(where, &answer, best, &tried);
        /* of rows that yield no cut is kept, so that they may go on in a circle */
        in_vain = ((tried.is_better != 0) || (answer.status == HARD)) ? 0 : (in_vain + 1);
        is_open = ((tried.holds == 0) && (answer.status < UNSOLVED)) ? 1 : 0;
        goes_on = ((is_open != 0) && (in_vain < IN_VAIN) && (pass < (PASSES - 1))) ? 1 : 0;
        if (goes_on != 0) {
            add_tangents(&program, where, pass, (answer.status == SLACK) ? 1 : 0, &tried.tangents);
        }
    }
    if (is_open != 0) {
        from_rest(where, &program, best);
        go_back(where, answer.control, tried.within, best);
    }
}
