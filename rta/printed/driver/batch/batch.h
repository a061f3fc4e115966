/* A column of a batch, by the filter for one spacecraft. Returns 1 where it finds no solution. */
long filter_one(long column, const void *const *in, const long *in_step, void *const *out, const long *out_step);

/* Columns first to last of a batch; returns of how many no solution was found. Arrays lie component first, `step`
 * numbers between two components of a column. */
long filter_batch(long first, long last, const void *const *in, const long *in_step, void *const *out,
                  const long *out_step);

/* Of what comes out: numbers; the status, then of thrust and torque; whether another control than the desired one is
 * applied, then whether each constraint is active. */
enum { NUMBERS = 0, STATUSES = 1, TRUTHS = 2 };
enum { NO_SOLUTION = 3 }; /* of a status */
