/*
 * The filter's quadratic programs, by the dual active-set method of Goldfarb and Idnani (1983).
 *
 * For three controls u in units of their actuators' limits,
 *
 *     minimise |u - u_des|^2 + sum_i w_i d_i^2   subject to   a_i u + b_i + d_i >= 0,  -1 <= u <= 1.
 *
 * From u_des clipped to the limits, where those it is beyond are active, rows become active one by one, the most violated first, at the cost of active
 * ones whose multiplier falls to zero, until no row is violated or the active rows exclude the next one. The limits of
 * the actuators are rows, too. In u and sqrt(w_i) d_i the program is a projection. Of the latter only those of active
 * rows are not zero (d_i = multiplier_i / w_i), so they are numbered by the places of active rows.
 */

#define BOUNDS 6 /* the first rows of a program: the actuators' limits */
#define STAGES_MAX (2 + CLASSES_MAX)
#define NORMAL_MAX (3 + ACTIVE_MAX) /* numbers of a normal: by u, and by the slack of the row at each place */

enum { RUNNING = 0, OPTIMAL = 1, INFEASIBLE = 2, FULL = 3 };     /* outcome of a step */

struct program {
    int rows;
    double desired[3];
    double a[ROWS_MAX][3];   /* of unit length or shorter */
    double b[ROWS_MAX];      /* with margins, which are spent before a limit is */
    double b_no_margin[ROWS_MAX]; /* without */
    double weight[ROWS_MAX]; /* of slack, and its priority; INFINITY: the row must hold */
};

struct answer {
    double control[3]; /* within [-1, 1] */
    int status;
    double residual; /* largest violation of the optimality conditions, INFINITY where nothing was solved */
};

/* What is asked in one stage: a side, and 1 / w_i, zero where a row must hold. */
struct stage {
    const struct program *program;
    const double *side;
    double relief[ROWS_MAX];
};

/* A solution on its way: active rows, each in a place, and the row that enters. */
struct solution {
    double u[3];
    double multiplier[ROWS_MAX];
    int count; /* of active rows */
    int row[ACTIVE_MAX];
    double inverse[ACTIVE_MAX][NORMAL_MAX]; /* pseudo-inverse of the active rows' normals */
    int entering;
    double pressure; /* the entering row's multiplier, zero before it started */
};

/* The entering row as a combination r of the active ones and a rest z: per unit of its multiplier, those of the active
 * rows change by -r and u moves along z. */
struct way {
    int place;
    double r[ACTIVE_MAX];
    double z[NORMAL_MAX + 1];
    double z2; /* |z|^2; zero if the row depends on the active ones */
};

/* x += share y */
static void add(double *x, double share, const double *y, int size)
{
    for (int i = 0; i < size; ++i) {
        x[i] += share * y[i];
    }
}

/* A program without rows but for the actuators' limits, u_j >= -1 and -u_j >= -1. */
static void begin_program(struct program *p, const double desired[3])
{
    p->rows = BOUNDS;
    copy(p->desired, desired, 3);
    for (int i = 0; i < BOUNDS; ++i) {
        for (int j = 0; j < 3; ++j) {
            p->a[i][j] = ((i % 3) != j) ? 0.0 : ((i < 3) ? 1.0 : -1.0);
        }
        p->b[i] = 1.0;
        p->b_no_margin[i] = 1.0;
        p->weight[i] = INFINITY;
    }
}

static int is_finite(const struct program *p)
{
    double sum = p->desired[0] + p->desired[1] + p->desired[2];
    for (int i = 0; i < p->rows; ++i) {
        sum += p->a[i][0] + p->a[i][1] + p->a[i][2] + p->b[i] + p->b_no_margin[i];
    }
    return isfinite(sum) ? 1 : 0;
}

/* A row's left-hand side, slack by its multiplier included. */
static double left_of(const struct stage *s, int row, const double u[3], double multiplier)
{
    return dot(s->program->a[row], u, 3) + s->side[row] + (multiplier * s->relief[row]);
}

/* The smallest left-hand side. Its row enters, unless one is on its way already. */
static double find_entering(const struct stage *s, struct solution *x)
{
    double lowest = INFINITY;
    int lowest_row = 0;
    for (int i = 0; i < s->program->rows; ++i) {
        const double left = left_of(s, i, x->u, x->multiplier[i]);
        if (left < lowest) {
            lowest = left;
            lowest_row = i;
        }
    }
    if (!(x->pressure > 0.0)) {
        x->entering = lowest_row;
    }
    return lowest;
}

/* Moves what is left along the active rows from z to r. */
static void project(const struct stage *s, const struct solution *x, struct way *way)
{
    double more[ACTIVE_MAX];
    for (int k = 0; k < x->count; ++k) {
        more[k] = dot(x->inverse[k], way->z, 3 + x->count);
    }
    for (int k = 0; k < x->count; ++k) {
        const int row = x->row[k];
        way->r[k] += more[k];
        way->z[3 + k] -= more[k] * sqrt(s->relief[row]);
        add(way->z, -more[k], s->program->a[row], 3);
    }
}

static void find_way(const struct stage *s, const struct solution *x, struct way *way)
{
    const double relief = s->relief[x->entering];
    const double *a = s->program->a[x->entering];
    way->place = x->count;
    for (int k = 0; k < x->count; ++k) {
        way->r[k] = 0.0;
        way->z[3 + k] = 0.0;
        if (x->row[k] == x->entering) {
            way->place = k; /* violated by rounding although it is active: it may only leave, and enter again later */
        }
    }
    copy(way->z, a, 3);
    way->z[3 + way->place] = sqrt(relief);
    project(s, x, way);
    project(s, x, way); /* once is not enough where rows are nearly parallel */
    way->z2 = dot(way->z, way->z, 3 + x->count + ((way->place == x->count) ? 1 : 0));
    if ((way->place < x->count) || (way->z2 <= (DEPENDENT * (dot(a, a, 3) + relief)))) {
        way->z2 = 0.0;
    }
}

/* How far until an active row's multiplier is zero: that at `blocking`. */
static double until_blocked(const struct solution *x, const struct way *way, int *blocking)
{
    double length = INFINITY;
    *blocking = 0;
    for (int k = 0; k < x->count; ++k) {
        const double multiplier = x->multiplier[x->row[k]];
        if ((way->r[k] > BLOCKING) && ((multiplier / way->r[k]) < length)) {
            length = multiplier / way->r[k];
            *blocking = k;
        }
    }
    return length;
}

/* The entering row becomes active; the pseudo-inverse grows by a row and a column. */
static void enter(struct solution *x, const struct way *way)
{
    const int size = 3 + x->count + 1;
    for (int k = 0; k < x->count; ++k) {
        x->inverse[k][size - 1] = 0.0;
        add(x->inverse[k], -way->r[k] / way->z2, way->z, size);
    }
    for (int i = 0; i < size; ++i) {
        x->inverse[x->count][i] = way->z[i] / way->z2;
    }
    x->row[x->count] = x->entering;
    x->multiplier[x->entering] = x->pressure;
    x->pressure = 0.0;
    x->count += 1;
}

/* The row at a place leaves; the pseudo-inverse of the others has nothing along it. The last one takes its place. */
static void leave(struct solution *x, int place)
{
    const int last = x->count - 1;
    const double *lost = x->inverse[place];
    const double lost2 = dot(lost, lost, 3 + x->count);
    for (int k = 0; k < x->count; ++k) {
        if (k != place) {
            add(x->inverse[k], -dot(x->inverse[k], lost, 3 + x->count) / lost2, lost, 3 + x->count);
        }
    }
    x->multiplier[x->row[place]] = 0.0;
    x->row[place] = x->row[last];
    copy(x->inverse[place], x->inverse[last], 3 + x->count);
    for (int k = 0; k < last; ++k) {
        x->inverse[k][3 + place] = x->inverse[k][3 + last];
    }
    x->count = last;
}

/* A row becomes active, or an active one that blocks its way leaves. */
static int go(const struct stage *s, struct solution *x, const struct way *way)
{
    int outcome = RUNNING;
    int blocking = 0;
    const double multiplier = x->multiplier[x->entering] + x->pressure;
    const double left = left_of(s, x->entering, x->u, multiplier);
    const double full = (way->z2 > 0.0) ? (-left / way->z2) : INFINITY;
    const double partial = until_blocked(x, way, &blocking);
    const double length = (full <= partial) ? full : partial;
    if (isinf(length) != 0) {
        outcome = INFEASIBLE;
    } else {
        if (way->z2 > 0.0) {
            add(x->u, length, way->z, 3);
        }
        for (int k = 0; k < x->count; ++k) {
            x->multiplier[x->row[k]] -= length * way->r[k];
        }
        x->pressure += length;
        if (full <= partial) {
            enter(x, way);
        } else {
            leave(x, blocking);
        }
    }
    return outcome;
}

static int step(const struct stage *s, struct solution *x)
{
    int outcome = OPTIMAL;
    struct way way;
    const double lowest = find_entering(s, x);
    if ((lowest < -VIOLATED) || (x->pressure > 0.0)) {
        find_way(s, x, &way);
        outcome = ((x->count == ACTIVE_MAX) && (way.z2 > 0.0)) ? FULL : go(s, x, &way);
    }
    return outcome;
}

/*
 * The largest violation of the optimality conditions. With multipliers m of the rows after the limits, slack m_i / w_i
 * and s_i = a_i u + b_i + m_i / w_i they are u = clip(u_des + sum_i m_i a_i, -1, 1), s_i >= 0, m_i >= 0 and
 * min(m_i, 1) s_i = 0, since rounding of s_i times a large m_i says little. NaN if any number is.
 */
static double kkt_residual(const struct stage *s, const double u[3], const double multiplier[ROWS_MAX])
{
    double forced[3] = {s->program->desired[0], s->program->desired[1], s->program->desired[2]};
    double most = 0.0;
    double sum = 0.0;
    for (int i = BOUNDS; i < s->program->rows; ++i) {
        const double left = left_of(s, i, u, multiplier[i]);
        add(forced, multiplier[i], s->program->a[i], 3);
        most = larger(larger(most, -left), fabs(smaller(multiplier[i], 1.0) * left));
        sum += fabs(multiplier[i]);
    }
    for (int i = BOUNDS; i < s->program->rows; ++i) {
        most = larger(most, -multiplier[i] - (ROUNDED * sum));
    }
    for (int j = 0; j < 3; ++j) {
        most = larger(most, fabs(u[j] - clip(forced[j], -1.0, 1.0)) - (ROUNDED * sum));
    }
    return most;
}

/* The optimum within the actuators' limits alone: those that the desired control is beyond are active, and their
 * multipliers are what it is beyond them. From u_des itself the steps would lose as many digits as it is large. */
static void begin_solution(const struct program *p, struct solution *x)
{
    x->count = 0;
    x->pressure = 0.0;
    for (int i = 0; i < p->rows; ++i) {
        x->multiplier[i] = 0.0;
    }
    for (int j = 0; j < 3; ++j) {
        x->u[j] = clip(p->desired[j], -1.0, 1.0);
        const double beyond = p->desired[j] - x->u[j];
        if (fabs(beyond) > 0.0) {
            double *inverse = x->inverse[x->count];
            int bound = j;
            if (beyond > 0.0) {
                bound = 3 + j;
            }
            for (int i = 0; i < BOUNDS; ++i) {
                inverse[i] = 0.0;
            }
            inverse[j] = p->a[bound][j];
            x->row[x->count] = bound;
            x->multiplier[bound] = fabs(beyond);
            x->count += 1;
        }
    }
}

/* Rows of up to a weight have slack: none where that is zero. Returns the residual; INFINITY: no control was found.
 * What takes more steps or more active rows than there is room for keeps the control so far, and its residual. */
static double solve_stage(const struct program *p, const double *side, double highest, double u[3])
{
    struct stage s = {.program = p, .side = side};
    struct solution x;
    int outcome = RUNNING;
    begin_solution(p, &x);
    for (int i = 0; i < p->rows; ++i) {
        s.relief[i] = (p->weight[i] <= highest) ? (1.0 / p->weight[i]) : 0.0;
    }
    for (int i = 0; (i < STEPS_MAX) && (outcome == RUNNING); ++i) {
        outcome = step(&s, &x);
    }
    for (int j = 0; j < 3; ++j) {
        u[j] = clip(x.u[j], -1.0, 1.0);
    }
    const double residual = kkt_residual(&s, u, x.multiplier);
    /* a row that only a corner of the limits satisfies may be missed by a last digit */
    return ((outcome == INFEASIBLE) && !(residual <= ACCURATE)) ? INFINITY : residual;
}

/* The lowest weight above another, INFINITY if there is none. */
static double next_class(const struct program *p, double highest)
{
    double next = INFINITY;
    for (int i = 0; i < p->rows; ++i) {
        if ((p->weight[i] > highest) && (p->weight[i] < next)) {
            next = p->weight[i];
        }
    }
    return next;
}

/* The first of the candidate controls that violates rows least: those that must hold, then the others by their weights. */
static void least_violating(const struct program *p, double candidates[][3], int count, double u[3])
{
    double least_must = INFINITY;
    double least_rest = INFINITY;
    for (int k = 0; k < count; ++k) {
        double must = 0.0;
        double rest = 0.0;
        for (int i = 0; i < p->rows; ++i) {
            const double lack = fmax(0.0, -(dot(p->a[i], candidates[k], 3) + p->b_no_margin[i]));
            if (isinf(p->weight[i]) != 0) {
                must += lack * lack;
            } else {
                rest += p->weight[i] * (lack * lack);
            }
        }
        if ((must < least_must) || ((must <= least_must) && (rest < least_rest))) {
            least_must = must;
            least_rest = rest;
            copy(u, candidates[k], 3);
        }
    }
}

/*
 * Solves a program in stages: every row held with its margin, then without; then slack is given class after class, in
 * ascending order of their weights. What no stage solves accurately gets the least-violating candidate, and zero
 * control if a number in it is not finite.
 */
static void solve(const struct program *p, struct answer *answer)
{
    double candidates[2 + STAGES_MAX][3] = {{0.0}}; /* desired, zero, and what stages answered */
    int count = 2;
    double highest = 0.0;
    const int finite = is_finite(p);
    for (int j = 0; j < 3; ++j) {
        candidates[0][j] = clip(p->desired[j], -1.0, 1.0);
    }
    copy(answer->control, candidates[1], 3);
    answer->status = UNSOLVED;
    answer->residual = INFINITY;
    for (int i = 0; (i < STAGES_MAX) && (finite != 0) && (answer->status == UNSOLVED); ++i) {
        highest = (i < 2) ? 0.0 : next_class(p, highest);
        if (isfinite(highest) != 0) {
            double *u = candidates[count];
            const double residual = solve_stage(p, (i == 0) ? p->b : p->b_no_margin, highest, u);
            if (residual <= ACCURATE) {
                answer->status = (i < 2) ? HARD : SLACK;
                answer->residual = residual;
                copy(answer->control, u, 3);
            } else if (isfinite(residual) != 0) {
                count += 1;
            } else {
                /* infeasible */
            }
        }
    }
    if ((finite != 0) && (answer->status == UNSOLVED)) {
        least_violating(p, candidates, count, answer->control);
    }
}
