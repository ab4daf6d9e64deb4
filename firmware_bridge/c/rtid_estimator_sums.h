/* What the estimator's files share among themselves; not for its users. */
#ifndef RTID_ESTIMATOR_SUMS_H
#define RTID_ESTIMATOR_SUMS_H

#include <float.h>
#include <math.h>

#include "rtid_estimator.h"

#ifdef __FAST_MATH__
#error "-ffast-math drops the checks for NaN and the compensated sums"
#endif

#define R(x) ((rtid_real)(x))
enum { T = RTID_EST_TERMS };
enum { FREE, OPEN, YOUNG, RINGING }; /* status of a recent block; young: closed since the ring began */
enum { TILES_PER_TICK = 4, ALL_TILES = RTID_EST_MAX_RECENT * RTID_EST_MAX_RECENT };
enum { SETTLE, FORGET_SILENT, END_ALL }; /* what a rebase does to the memory of closed blocks */
#define FORGET_AT R(1e-3) /* look for silent blocks each time that all memory has faded so far */

#ifdef RTID_ESTIMATOR_FLOAT32

#define ROOT sqrtf
#define EXP expf
#define ABS fabsf
/* No quantity in SI units is that large, and its square is still a number. */
#define INSANE 1e9f
#define SILENT 1e-7f    /* a closed block whose state decayed to this share is forgotten */
#define LEAST_PIVOT FLT_EPSILON /* of a unit diagonal: below, sums hold but their own rounding */
#define RING_LIMIT 0.3f /* rebase before the ring's column loses digits */
#define CONDITION_MOST 1e6

/* s += x + rest, rest far below x; Knuth: the sum, and what it rounded off. */
static inline void add_pair(rtid_sum *s, rtid_real x, rtid_real rest)
{
    const rtid_real t = s->high + x, back = t - s->high;
    s->low += ((s->high - (t - back)) + (x - back)) + rest;
    s->high = t;
}

/* Products are exact: rounded to one float each, they would not be those of any rows, and lose the
 * directions that few rows tell. */
static inline void add_product(rtid_sum *s, rtid_real a, rtid_real b)
{
    const rtid_real p = a * b;
#ifdef __FP_FAST_FMAF
    add_pair(s, p, fmaf(a, b, -p));
#else
    add_pair(s, p, (rtid_real)((double)a * b - p)); /* the same number */
#endif
}

static inline void add(rtid_sum *s, rtid_real x) { add_pair(s, x, 0); }
static inline void merge(rtid_sum *s, rtid_sum x) { add_pair(s, x.high, x.low); }

static inline rtid_real since(rtid_sum now, rtid_sum then) { return (now.high - then.high) + (now.low - then.low); }
static inline rtid_real rounded(rtid_sum s) { return s.high + s.low; }
static inline double exact(rtid_sum s) { return (double)s.high + (double)s.low; }
static inline rtid_sum no_sum(void) { return (rtid_sum){0.0f, 0.0f}; }

#else

#define ROOT sqrt
#define EXP exp
#define ABS fabs
#define INSANE 1e30
#define SILENT 1e-11
#define LEAST_PIVOT DBL_EPSILON
#define RING_LIMIT 0.1
#define CONDITION_MOST HUGE_VAL

static inline void add(rtid_sum *s, rtid_real x) { *s += x; }
static inline void add_product(rtid_sum *s, rtid_real a, rtid_real b) { *s += a * b; }
static inline void merge(rtid_sum *s, rtid_sum x) { *s += x; }
static inline rtid_real since(rtid_sum now, rtid_sum then) { return now - then; }
static inline rtid_real rounded(rtid_sum s) { return s; }
static inline double exact(rtid_sum s) { return s; }
static inline rtid_sum no_sum(void) { return 0.0; }

#endif

static inline int first_of(int k) { return RTID_EST_OPEN_AT + T * k; }

/* Units of the unknowns: rated flow of an edge, m3/s; scale of a shared one; terms that a map has. */
double rtid_est_rated(int edge);
double rtid_est_shared_scale(int shared);
int rtid_est_has_term(int edge, int term);

/* Let n blocks be open; the width of the rows follows. */
void rtid_est_set_open(rtid_estimator *e, int n);

/* Let open block k ring on, its state referred to the ring's origin; clear its columns. */
void rtid_est_close(rtid_estimator *e, int k);

/* Make `slot` open block k, a place just closed or n_open; if it still rings, it goes on. */
void rtid_est_open(rtid_estimator *e, int k, int edge, int slot);

/* Take the closed and cleared block k out of the open ones; the last one takes its place. */
void rtid_est_remove_open(rtid_estimator *e, int k);

/* Work off so many tiles of what the last rebase left. */
void rtid_est_pay(rtid_estimator *e, int tiles);

/* Settle all products, start the ring anew; with END_ALL all states are zero. */
void rtid_est_rebase(rtid_estimator *e, int how);

/* END_ALL, and no block stays open. */
void rtid_est_end(rtid_estimator *e);

#endif
