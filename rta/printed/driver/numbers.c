/* What all of it needs. */

enum { THRUST = 0, TORQUE = 1 }; /* a group of three actuators, controls 3 group, ... */
enum { UNTOUCHED = 0, HARD = 1, SLACK = 2, UNSOLVED = 3 }; /* status */

/* NaN stays. */
static double clip(double x, double low, double high)
{
    const double raised = (x < low) ? low : x;
    return (raised > high) ? high : raised;
}

#if PROGRAMS
/* NaN if either is. */
static double smaller(double a, double b)
{
    return ((a <= b) || isnan(a)) ? a : b;
}

static double larger(double a, double b)
{
    return -smaller(-a, -b);
}

static double dot(const double *a, const double *b, int size)
{
    double sum = 0.0;
    for (int i = 0; i < size; ++i) {
        sum += a[i] * b[i];
    }
    return sum;
}
#endif

static void copy(double *x, const double *y, int size)
{
    for (int i = 0; i < size; ++i) {
        x[i] = y[i];
    }
}
