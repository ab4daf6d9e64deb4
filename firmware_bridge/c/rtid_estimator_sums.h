/* What the estimator's files share among themselves; not for its users. */
#ifndef RTID_ESTIMATOR_SUMS_H
#define RTID_ESTIMATOR_SUMS_H

#include <math.h>
#include <stdbool.h>

#include "rtid_estimator.h"

#ifdef __FAST_MATH__
#error "-ffast-math drops the checks for NaN and the compensated sums"
#endif

#define R(x) ((rtid_real)(x))
enum { T = RTID_EST_TERMS, SHUT = -1 };
/* A visit is open, rings, rings beside a later visit of the same block, is silent but owes still, or
 * has gone on as another visit. */
enum { FREE, OPEN, RINGING, ECHO, SILENT_NOW, ENDED };
enum { LEAST_PAID = 2, MOST_PAID = RTID_EST_TILES_PER_TICK * 2 / 3 }; /* of what is owed, per tick */
enum { MOST_SCANNED = 16 }; /* visits that are looked at for one that can be merged */
enum { MOST_APART = 40 };   /* epochs, in bits, between two that are merged */
#define RING_LIMIT R(0.1) /* its unit is made smaller before its sums lose digits */
#define FORGET_AT R(1e-3) /* look for silent blocks each time that all memory has faded so far */

#ifdef RTID_ESTIMATOR_FLOAT32

#define ROOT sqrtf
#define EXP expf
#define ABS fabsf
/* No quantity in SI units is that large, and its square is still a number. */
#define INSANE 1e9f
#define MOST 9.99999e8
#define FREXP frexpf
#define LDEXP ldexpf
/* Rounding of the samples: of a block mean, in shares of the rated flow; of a shared unknown, of
 * itself.  More data do not make it less. */
#define FLOW_ROUNDING 3e-4
#define SHARED_ROUNDING 4e-5
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

/* s += a b to the same bits, of an epoch: its few rows leave low small, and merge orders it. */
static inline void add_product(rtid_sum *s, rtid_real a, rtid_real b)
{
    const rtid_sum x = product(a, b);
    const rtid_real t = s->high + x.high, back = t - s->high;
    s->low += ((s->high - (t - back)) + (x.high - back)) + x.low;
    s->high = t;
}

static inline rtid_sum times(rtid_sum a, rtid_real b)
{
    rtid_sum p = product(a.high, b);
    p.low += a.low * b;
    return p;
}

/* a b, b a power of two */
static inline rtid_sum scaled(rtid_sum a, rtid_real b) { return (rtid_sum){a.high * b, a.low * b}; }

static inline rtid_sum as_sum(rtid_real x) { return (rtid_sum){x, 0.0f}; }
static inline rtid_sum minus(rtid_sum a) { return (rtid_sum){-a.high, -a.low}; }
static inline double exact(rtid_sum s) { return (double)s.high + (double)s.low; }

#else

#define ROOT sqrt
#define EXP exp
#define ABS fabs
#define INSANE 1e30
#define MOST 9.99999e29
#define FREXP frexp
#define LDEXP ldexp
#define FLOW_ROUNDING 0.0 /* below all deviations */
#define SHARED_ROUNDING 0.0
#define SILENT 1e-11

static inline void merge(rtid_sum *s, rtid_sum x) { *s += x; }
static inline rtid_sum product(rtid_real a, rtid_real b) { return a * b; }
static inline void add_product(rtid_sum *s, rtid_real a, rtid_real b) { *s += a * b; }
static inline rtid_sum times(rtid_sum a, rtid_real b) { return a * b; }
static inline rtid_sum scaled(rtid_sum a, rtid_real b) { return a * b; }
static inline rtid_sum as_sum(rtid_real x) { return x; }
static inline rtid_sum minus(rtid_sum a) { return -a; }
static inline double exact(rtid_sum s) { return s; }

#endif

static inline rtid_sum sum_of(rtid_sum a, rtid_sum b)
{
    merge(&a, b);
    return a;
}

static inline int first_of(int k) { return RTID_EST_OPEN_AT + (T * k); }

/* Units of the unknowns: rated flow of an edge, m3/s; scale of a shared one; terms of a map. */
double rtid_est_rated(int edge);
double rtid_est_shared_scale(int shared);
bool rtid_est_has_term(int edge, int term);

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

/* Let open block k ring on; clear its columns. */
void rtid_est_close(rtid_estimator *e, int k);

/* Make `slot` open block k, a place just closed or n_open; if it still rings, it goes on. */
void rtid_est_open(rtid_estimator *e, int k, int edge, int slot);

/* Take the closed and cleared block k out of the open ones; the last one takes its place. */
void rtid_est_remove_open(rtid_estimator *e, int k);

/* The line is too long to go on. */
bool rtid_est_is_full(const rtid_estimator *e);

/* Work off tiles that are owed, as far as this tick's go. */
void rtid_est_pay(rtid_estimator *e);

/* Add what open blocks and shared columns have, begin a new epoch in which the ring is 0.5 to 1. */
void rtid_est_renew(rtid_estimator *e);

/* Look for blocks that are silent. */
void rtid_est_forget(rtid_estimator *e);

/* End all memory; open blocks stay open, from nothing. */
void rtid_est_end(rtid_estimator *e);

/* The same, and no block stays open. */
void rtid_est_stop(rtid_estimator *e);

/* Ring x column of a visit up to now, in units of its epoch. */
void rtid_est_left(const rtid_estimator_owed *o, const rtid_estimator_visit *v, rtid_sum *left);

/* Ring x ring, and ring x column j of y and the shared ones, of a visit since it closed. */
rtid_sum rtid_est_ring(const rtid_estimator_owed *o, const rtid_estimator_visit *v);
rtid_sum rtid_est_shared(const rtid_estimator_owed *o, const rtid_estimator_visit *v, int j);

/* What open block k shares with the ring goes from its columns to its visit. */
void rtid_est_take_left(rtid_estimator_owed *o, int k);

/* Frozen sums become numbers, with what is owed to them. */
void rtid_est_settle(rtid_estimator_work *w);

/* The state of a closed visit counts still. */
bool rtid_est_rings(const rtid_estimator_visit *v);

/* What turns left x d, each in units of its visit, into a product. */
rtid_real rtid_est_units(const rtid_estimator_visit *later, const rtid_estimator_visit *earlier);

#endif
