/* What a printed function is made of, for W spacecraft at once: V is a vector of numbers, M of truth values, all bits
   set where true. Functions of math.h are called lane by lane, so that a lane's bits do not depend on W. */
typedef real V __attribute__((vector_size(W * sizeof(real))));
typedef whole M __attribute__((vector_size(W * sizeof(real))));

#define YES (~(M){0})
#define NO ((M){0})
#define ALL(number) ((real)(number) - (V){0})
#define NOT(m) (~(m))
#define AND(m, n) ((m) & (n))
#define OR(m, n) ((m) | (n))
#define ANY(m) any_v(m)
#define SELECT(m, a, b) select_v(m, a, b)
#define CHOOSE(m, a, b) (((m) & (a)) | (~(m) & (b)))
/* NaN if either is; of a literal, which is none, if a is */
#define MIN(a, b) SELECT(((a) < (b)) | ((a) != (a)), a, b)
#define MAX(a, b) SELECT(((a) > (b)) | ((a) != (a)), a, b)
#define MIN_LITERAL(a, b) SELECT((b) < (a), b, a)
#define MAX_LITERAL(a, b) SELECT((b) > (a), b, a)
#define FABS(a) ((V)((M)(a) & ~(M)(-(V){0})))

static inline __attribute__((always_inline)) V select_v(M m, V a, V b)
{
    return (V)((m & (M)a) | (~m & (M)b));
}

static inline int any_v(M m)
{
    int found = 0;
    for (int lane = 0; lane < W; lane++) {
        found |= m[lane] != 0;
    }
    return found;
}

/* LANES and LANES_OF_TWO list what a function gives of each lane, without a loop, which compilers take long for */
#define BY_LANE(NAME, function, how)      \
    static how V NAME(V a)                \
    {                                     \
        return (V){LANES(function)};      \
    }
#define BY_LANE_OF_TWO(NAME, function)       \
    static V NAME(V a, V b)                  \
    {                                        \
        return (V){LANES_OF_TWO(function)};  \
    }

/* an entry of a table of so many; where there is none, the first */
#define LOOKUP(table, count, at) lookup(table, count, at)

static inline V lookup(const real *table, long count, V at)
{
    V result;
    for (int lane = 0; lane < W; lane++) {
        result[lane] = table[at[lane] >= 0 && at[lane] < count ? (long)at[lane] : 0];
    }
    return result;
}

/* What is in memory, component first: a column's neighbours follow it. Of the last block some lanes are repeated. */
typedef float SINGLES __attribute__((vector_size(W * sizeof(float))));
typedef double DOUBLES __attribute__((vector_size(W * sizeof(double))));
typedef uint8_t BYTES __attribute__((vector_size(W * sizeof(uint8_t))));
typedef int64_t WHOLES __attribute__((vector_size(W * sizeof(int64_t))));

#define SINGLE(a) __builtin_convertvector(__builtin_convertvector(a, SINGLES), V)

#define LOAD(NAME, LANES, type, result, convert)                     \
    static inline result NAME(const void *from, long at, long left)  \
    {                                                                \
        LANES lanes;                                                 \
        const type *const first = (const type *)from + at;           \
        if (left >= W) {                                             \
            memcpy(&lanes, first, sizeof lanes);                     \
        } else {                                                     \
            for (int lane = 0; lane < W; lane++) {                   \
                lanes[lane] = first[lane < left ? lane : left - 1];  \
            }                                                        \
        }                                                            \
        return convert;                                              \
    }
#define STORE(NAME, LANES, type, given, convert)                              \
    static inline void NAME(void *to, long at, long left, given value)        \
    {                                                                         \
        const LANES lanes = convert;                                          \
        type *const first = (type *)to + at;                                  \
        if (left >= W) {                                                      \
            memcpy(first, &lanes, sizeof lanes);                              \
        } else {                                                              \
            for (int lane = 0; lane < left; lane++) {                         \
                first[lane] = lanes[lane];                                    \
            }                                                                 \
        }                                                                     \
    }
LOAD(load_double, DOUBLES, double, V, __builtin_convertvector(lanes, V))
LOAD(load_float, SINGLES, float, V, __builtin_convertvector(lanes, V))
LOAD(load_long, WHOLES, int64_t, V, __builtin_convertvector(lanes, V))
LOAD(load_bool, BYTES, uint8_t, M, (M)(__builtin_convertvector(lanes, M) != 0))
STORE(store_double, DOUBLES, double, V, __builtin_convertvector(value, DOUBLES))
STORE(store_float, SINGLES, float, V, __builtin_convertvector(value, SINGLES))
STORE(store_long, WHOLES, int64_t, V, __builtin_convertvector(value, WHOLES))
STORE(store_bool, BYTES, uint8_t, M, __builtin_convertvector(value & 1, BYTES))
