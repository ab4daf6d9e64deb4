/* What the estimator's files share among themselves; not for its users. */
#ifndef RTID_ESTIMATOR_SUMS_H
#define RTID_ESTIMATOR_SUMS_H

#include <math.h>

#include "rtid_estimator.h"

#ifdef __FAST_MATH__
#error "-ffast-math drops the checks for NaN and the compensated sums"
#endif

#define R(x) ((rtid_real)(x))
enum { T = RTID_EST_TERMS, SHUT = -1 };
enum { FREE, OPEN, YOUNG, RINGING }; /* a recent block; young: closed since the ring began */
enum { TILES_PER_TICK = 4, ALL_TILES = RTID_EST_MAX_RECENT * RTID_EST_MAX_RECENT };
enum { SETTLE, FORGET_SILENT, END_ALL }; /* what a rebase does to the memory of closed blocks */
#define RING_LIMIT R(0.1) /* rebase before the ring's column loses digits */
#define FORGET_AT R(1e-3) /* look for silent blocks each time that all memory has faded so far */

#ifdef RTID_ESTIMATOR_FLOAT32

#define ROOT sqrtf
#define EXP expf
#define ABS fabsf
/* No quantity in SI units is that large, and its square is still a number. */
#define INSANE 1e9f
#define SILENT 1e-7f /* a closed block whose state decayed to this share is forgotten */

/* s += x to 48 bits: Knuth's sum of two numbers with what it rounded off, then brought in order */
static inline void merge(rtid_sum *s, rtid_sum x)
{
    const rtid_real t = s->high + x.high, back = t - s->high;
    const rtid_real rest = s->low + (((s->high - (t - back)) + (x.high - back)) + x.low);
    s->high = t + rest;
    s->low = rest - (s->high - t);
}

/* a b without rounding: products of rounded numbers would not be those of any rows, and the
 * directions that few rows tell would be lost. */
static inline rtid_sum product(rtid_real a, rtid_real b)
{
    const rtid_real p = a * b;
#ifdef __FP_FAST_FMAF
    return (rtid_sum){p, fmaf(a, b, -p)};
#else
    return (rtid_sum){p, (rtid_real)((double)a * b - p)}; /* the same numbers */
#endif
}

static inline rtid_sum times(rtid_sum a, rtid_real b)
{
    rtid_sum p = product(a.high, b);
    p.low += a.low * b;
    return p;
}

static inline rtid_sum as_sum(rtid_real x) { return (rtid_sum){x, 0.0f}; }
static inline rtid_sum minus(rtid_sum a) { return (rtid_sum){-a.high, -a.low}; }
static inline double exact(rtid_sum s) { return (double)s.high + (double)s.low; }

#else

#define ROOT sqrt
#define EXP exp
#define ABS fabs
#define INSANE 1e30
#define SILENT 1e-11

static inline void merge(rtid_sum *s, rtid_sum x) { *s += x; }
static inline rtid_sum product(rtid_real a, rtid_real b) { return a * b; }
static inline rtid_sum times(rtid_sum a, rtid_real b) { return a * b; }
static inline rtid_sum as_sum(rtid_real x) { return x; }
static inline rtid_sum minus(rtid_sum a) { return -a; }
static inline double exact(rtid_sum s) { return s; }

#endif

static inline rtid_sum sum_of(rtid_sum a, rtid_sum b)
{
    merge(&a, b);
    return a;
}

static inline int first_of(int k) { return RTID_EST_OPEN_AT + T * k; }

/* Units of the unknowns: rated flow of an edge, m3/s; scale of a shared one; terms of a map. */
double rtid_est_rated(int edge);
double rtid_est_shared_scale(int shared);
int rtid_est_has_term(int edge, int term);

/* Keep the sample: it is the start of the next interval. */
void rtid_est_remember(rtid_estimator *e, const rtid_estimator_sample *sample);

/* Begin at the measured position that was remembered: spools at rest, whitener at R. */
void rtid_est_begin(rtid_estimator *e);

/* Find the block of every edge over the interval; RTID_EST_TAKEN or the reason against it. */
int rtid_est_place(rtid_estimator *e, const rtid_real *now, int64_t dt_us);

/* Integrate the columns over the interval; make a row where the position was measured. */
void rtid_est_integrate(rtid_estimator *e, const rtid_estimator_sample *sample);

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
