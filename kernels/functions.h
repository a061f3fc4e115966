/* Sine, cosine and arc cosine, each as one text for a number and for a vector, so that their bits are the same there and
 * with every library of C. The polynomials are fits at Chebyshev's points; an error is 1.75 units in the last place at most,
 * measured against 40 digits (tests/kernels/test_functions.py). The sine of -0 is +0. */

#ifndef FARTHEST_ANGLE
#define FARTHEST_ANGLE 1e5 /* rad, up to which the three parts of pi / 2 take it to within pi / 4 */

/* Sine of x + quarter pi / 2, |x| at most FARTHEST_ANGLE. */
static inline V sine_from(V x, double quarter)
{
    const V k = RINT(x * 0.6366197723675814);
    const V r = ((x - k * 1.5707963267341256) - k * 6.077100506303966e-11) - k * 2.0222662487959506e-21;
    const V z = r * r;
    const V s = ((((((-7.58549250782124e-13 * z + 1.605851097953535e-10) * z - 2.5052106100926675e-08) * z +
                    2.755731921895673e-06) * z - 0.0001984126984126457) * z + 0.008333333333333331) * z -
                 0.16666666666666666) * z;
    const V c = ((((((4.745202155702359e-14 * z - 1.147044941240971e-11) * z + 2.0876755717957296e-09) * z -
                    2.75573192211902e-07) * z + 2.480158730158437e-05) * z - 0.0013888888888888887) * z +
                 0.041666666666666664) * z;
    const V turns = (k + quarter) * 0.25;
    const V rest = turns - FLOOR(turns); /* 0, 1/4, 1/2 or 3/4 */
    const V odd = rest * 2.0;
    const V found = SELECT(odd - FLOOR(odd) == 0.5, 1.0 - (0.5 * z - c * z), r + s * r);
    return SELECT(rest >= 0.5, -found, found);
}

static inline V sine(V x)
{
    const M is_far = FABS(x) > FARTHEST_ANGLE;
    const V found = sine_from(x, 0.0);
    return ANY(is_far) ? SELECT(is_far, LIBRARY_SIN(x), found) : found;
}

static inline V cosine(V x)
{
    const M is_far = FABS(x) > FARTHEST_ANGLE;
    const V found = sine_from(x, 1.0);
    return ANY(is_far) ? SELECT(is_far, LIBRARY_COS(x), found) : found;
}

/* Of |x| > 1/2 by half the angle, whose sine is sqrt((1 - |x|) / 2). */
static inline V arc_cosine(V x)
{
    const M is_far = FABS(x) > 0.5;
    const V z = SELECT(is_far, 0.5 - 0.5 * FABS(x), x * x);
    const V s = SELECT(is_far, SQRT(z), x);
    const V p = ((((((((((((0.02877844261259304 * z - 0.014881409392818066) * z + 0.017419357964884856) * z +
                          0.00545087818772055) * z + 0.010324318288744113) * z + 0.011478952690257387) * z +
                       0.013971235301124539) * z + 0.017352391265909227) * z + 0.022372173002005596) * z +
                    0.030381944137085216) * z + 0.04464285714637338) * z + 0.07499999999998425) * z +
                 0.16666666666666669) * z;
    const V sine_is = s + s * p; /* the angle whose sine is s */
    const V direct = 1.5707963267948966 - (s - (6.123233995736766e-17 - s * p));
    const V doubled = 2.0 * sine_is;
    return SELECT(is_far, SELECT(x < 0.0, 3.141592653589793 - (doubled - 1.2246467991473532e-16), doubled), direct);
}

#define SIN(x) sine(x)
#define COS(x) cosine(x)
#define ACOS(x) arc_cosine(x)
#endif
