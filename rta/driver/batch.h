/* A column of a batch, by the filter for one spacecraft. */
void filter_one(long column, const void *const *in, const long *in_step, void *const *out, const long *out_step);

/* Columns first to last of a batch. Arrays lie component first, `step` numbers between two components of a column. */
void filter_batch(long first, long last, const void *const *in, const long *in_step, void *const *out,
                  const long *out_step);

enum { NUMBERS = 0, STATUSES = 1, TRUTHS = 2 }; /* of what comes out */
