/* What a printed function is made of, for one spacecraft: V is a number, M a truth value. */
typedef real V;
typedef int M;

#define YES 1
#define NO 0
#define ALL(number) ((V)(number))
#define NOT(m) (!(m))
#define AND(m, n) ((m) && (n))
#define OR(m, n) ((m) || (n))
#define ANY(m) (m)
#define SELECT(m, a, b) ((m) ? (a) : (b))
/* NaN if either is; of a literal, which is none, if a is */
#define MIN(a, b) ((((a) < (b)) || ((a) != (a))) ? (a) : (b))
#define MAX(a, b) ((((a) > (b)) || ((a) != (a))) ? (a) : (b))
#define MIN_LITERAL(a, b) (((b) < (a)) ? (b) : (a))
#define MAX_LITERAL(a, b) (((b) > (a)) ? (b) : (a))
#define SINGLE(a) ((V)(float)(a))
/* an entry of a table of so many; where there is none, the first */
#define LOOKUP(table, count, at) ((table)[((at) >= 0 && (at) < (count)) ? (long)(at) : 0])
/* an index into so many entries; where there is none, the last */
#define PLACE(count, at) (((at) >= 0 && (at) < (count)) ? (long)(at) : (count) - 1)
