/* Flights of the laws from states, W at a time: where one ends another one begins, for some are ten times as long as others. */
struct flights {
    V y[16];
    M broken[LIMITS];
    M alive[2];
    M found[2];
    long column[W];
    int holds[W];
    int count;
};

static void put_truths(M *to, int place, const M *from, int lane, int count)
{
    for (int i = 0; i < count; ++i) {
        to[i][place] = from[i][lane];
    }
}

/* Begins a flight, of which the limits of groups that are asked for matter, where there is room. */
static void begin_flight(struct flights *these, const V y[16], const M broken[LIMITS], const M asked[2], int lane, long column)
{
    const int place = these->count;
    put_lane(these->y, place, y, lane, 16);
    put_truths(these->broken, place, broken, lane, LIMITS);
    put_truths(these->alive, place, asked, lane, 2);
    for (int group = 0; group < 2; ++group) {
        these->found[group][place] = ~asked[group][lane];
    }
    these->column[place] = column;
    these->holds[place] = 0;
    these->count += 1;
}

/* Flies all on. */
static void fly_all(struct flights *these)
{
    fly_on(these->y, these->broken, GLANCES, these->alive, these->found);
    for (int lane = 0; lane < these->count; ++lane) {
        these->holds[lane] += GLANCES;
    }
}

/* Whether nothing more is to be known of a flight. */
static int has_ended(const struct flights *these, int lane)
{
    return !(these->alive[0][lane] | these->alive[1][lane]) || these->holds[lane] >= FLIGHT_HOLDS;
}

/* Gives a flight's place to the last one. */
static void end_flight(struct flights *these, int lane)
{
    const int last = these->count - 1;
    put_lane(these->y, lane, these->y, last, 16);
    put_truths(these->broken, lane, these->broken, last, LIMITS);
    put_truths(these->alive, lane, these->alive, last, 2);
    put_truths(these->found, lane, these->found, last, 2);
    these->column[lane] = these->column[last];
    these->holds[lane] = these->holds[last];
    these->alive[0][last] = 0;
    these->alive[1][last] = 0;
    these->count = last;
}

/* Flies on until there is room, or `all` have ended, and stores which keep their limits. */
static void store_flights(struct flights *these, int all, void *const *out, const long *out_step)
{
    while (these->count == W || (all && these->count > 0)) {
        fly_all(these);
        for (int lane = these->count - 1; lane >= 0; --lane) {
            if (has_ended(these, lane)) {
                for (int group = 0; group < 2; ++group) {
                    ((unsigned char *)out[0])[group * out_step[0] + these->column[lane]] = these->found[group][lane] != 0;
                }
                end_flight(these, lane);
            }
        }
    }
}

/* Whether the laws' flight from each state keeps the limits of each group that are not broken, and ends; of groups that are
 * asked for. In: states, broken limits, groups. */
long filter_flights(long first, long last, const void *const *in, const long *in_step, void *const *out,
                    const long *out_step)
{
    struct flights these = {.count = 0};
    for (long column = first; column < last; column += W) {
        const long lanes = last - column;
        V x[16];
        M broken[LIMITS];
        M asked[2];
        load_block(in[0], in_step[0], column, lanes, 16, x);
        for (int k = 0; k < LIMITS; ++k) {
            broken[k] = load_bool(in[1], k * in_step[1] + column, lanes);
        }
        for (int group = THRUSTS; group <= TORQUES; ++group) {
            asked[group] = load_bool(in[2], group * in_step[2] + column, lanes);
        }
        for (int lane = 0; lane < W && lane < lanes; ++lane) {
            begin_flight(&these, x, broken, asked, lane, column + lane);
            store_flights(&these, 0, out, out_step);
        }
    }
    store_flights(&these, 1, out, out_step);
    return 0;
}
