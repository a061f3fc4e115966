/* How the columns of a batch go through a function whose loops wait, see waiting.py. Printed before this: NUMBERS, TRUTHS,
 * CHUNK, and LOOPS, how many loops wait in the function itself. */

/* What a column that waits needs later: numbers, truth values, and its place in the batch. */
struct record {
    real n[NUMBERS];
    whole m[TRUTHS];
    long column;
};

/* Up to CHUNK columns on their way. */
struct work {
    struct record records[CHUNK];
    int count;              /* of records */
    int list[LOOPS][CHUNK]; /* those that wait for each loop */
    int waits[LOOPS];       /* how many came from the straight way */
    void *const *out;       /* where results go, and how far apart components are */
    const long *out_step;
};

/* A segment of `count` columns of a list; appends those that want to go on to another one, and returns its length. */
typedef int segment(struct work *work, const int *list, int count, int *to, int there);

/* All turns of `count` columns of a list. */
typedef void loop(struct work *work, const int *list, int count);

/* A value of W records. */
#define NUMBERS_AT(place) ((V){OF_RECORDS(n[place])})
#define TRUTHS_AT(place) ((M){OF_RECORDS(m[place])})

/* The records of W columns of a list, from one on; of the last W some are repeated. */
static void gather(struct record *at[W], struct work *work, const int *list, int first, int count)
{
    for (int lane = 0; lane < W; ++lane) {
        at[lane] = &work->records[list[(first + lane < count) ? first + lane : count - 1]];
    }
}

/* Appends those of W columns that want to go on; returns how many there are then. */
static int append(int *to, int there, const int *list, int first, int count, M wants)
{
    for (int lane = 0; lane < W && first + lane < count; ++lane) {
        if (wants[lane]) {
            to[there] = list[first + lane];
            ++there;
        }
    }
    return there;
}

/* Gives columns that leave the straight way for a loop a record each. */
static void leave(struct work *work, int number, M wants, long column, struct record *at[W])
{
    for (int lane = 0; lane < W; ++lane) {
        if (wants[lane]) {
            at[lane] = &work->records[work->count];
            at[lane]->column = column + lane;
            work->list[number][work->waits[number]] = work->count;
            ++work->waits[number];
            ++work->count;
        }
    }
}

/* All turns of columns of a list round a loop whose body has segments, and loops between them. */
static void go_round(struct work *work, const int *list, int count, segment *const *segments, loop *const *loops,
                     int last, int most)
{
    int ready[CHUNK];
    int wants[CHUNK];
    memcpy(ready, list, sizeof *list * count);
    for (int k = 0; k < most && count > 0; ++k) {
        for (int i = 0; i < last; ++i) {
            loops[i](work, wants, segments[i](work, ready, count, wants, 0));
        }
        count = segments[last](work, ready, count, wants, 0);
        memcpy(ready, wants, sizeof *wants * count);
    }
}

/* Columns that have left the straight way go the rest of it. */
static void go_on(struct work *work, segment *const *segments, loop *const *loops)
{
    int ready[CHUNK];
    int count = 0;
    for (int i = 0; i < LOOPS; ++i) {
        int *const list = work->list[i];
        int there = work->waits[i];
        if (i > 0) {
            there = segments[i](work, ready, count, list, there);
        }
        loops[i](work, list, there);
        memcpy(&ready[count], list, sizeof *list * work->waits[i]);
        count += work->waits[i];
    }
    segments[LOOPS](work, ready, count, ready, 0);
}
