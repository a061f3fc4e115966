/* All columns, one by one. */

long filter_batch(long first, long last, const void *const *in, const long *in_step, void *const *out,
                  const long *out_step)
{
    long unsolved = 0;
    for (long column = first; column < last; ++column) {
        unsolved += filter_one(column, in, in_step, out, out_step);
    }
    return unsolved;
}
