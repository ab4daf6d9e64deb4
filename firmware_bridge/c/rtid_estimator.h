/* The estimator for a controller with no computer beside it: one chamber and the metering edges of
 * one valve, the same update and the same equations as rtid/kernels (integral form, Taylor blocks):
 *
 *     s A (x_k+1 - x_k) = - V (P_k+1 - P_k) theta_beta + sum over open edges of sigma int Q dt
 *                         + sum over shared terms                           (eq. 14, integrated)
 *
 * C99, no heap, no state but what the caller hands in.  rtid_estimator_tables.h, which holds the
 * machine and fixes all sizes, is written by `rtid mcu` from the project file.  One double or, with
 * -DRTID_ESTIMATOR_FLOAT32, one float per number in the update; what is summed up for ever is then
 * kept in two floats.  The solution is computed in double precision, on demand, outside the tick.
 * Compile without -ffast-math: NaN means "not available", and compensated sums must stay.
 * The work of an update is bounded, whatever was learned; no function is recursive.
 *
 *     static rtid_estimator e;  static rtid_estimator_work w;  rtid_estimator_solution s;
 *     rtid_estimator_start(&e);
 *     every tick:      rtid_estimator_update(&e, &sample);
 *     on demand:       rtid_estimator_freeze(&e, &w);     while no update runs: copies
 *                      rtid_estimator_solve(&w, &s);      anywhere, while updates go on
 */
#ifndef RTID_ESTIMATOR_H
#define RTID_ESTIMATOR_H

#include <stdint.h>

#include "rtid_estimator_tables.h"

#ifdef RTID_ESTIMATOR_FLOAT32
typedef float rtid_real;
typedef struct {
    float high, low; /* of a sum that goes on for ever */
} rtid_sum;
#else
typedef double rtid_real;
typedef double rtid_sum;
#endif

#define RTID_EST_TERMS 6 /* 1, xi, eta, xi^2, eta^2, xi eta of a block, eq. (6) */
#define RTID_EST_SHARED (1 + RTID_EST_N_TERMS)
#define RTID_EST_BLOCKS_AT (1 + RTID_EST_SHARED) /* [y | shared | blocks] in the sums */
#define RTID_EST_RING (1 + RTID_EST_SHARED)      /* [y | shared | ring | open blocks] in rows */
#define RTID_EST_OPEN_AT (RTID_EST_RING + 1)
#define RTID_EST_WIDTH (RTID_EST_OPEN_AT + RTID_EST_TERMS * RTID_EST_MAX_OPEN)
#define RTID_EST_UNKNOWNS (RTID_EST_SHARED + RTID_EST_TERMS * RTID_EST_MAX_BLOCKS)
/* of a block with y, the shared columns and its own terms up to each */
#define RTID_EST_KEPT \
    (RTID_EST_TERMS * RTID_EST_BLOCKS_AT + RTID_EST_TERMS * (RTID_EST_TERMS + 1) / 2)
/* Work of one tick beside its row, in products of two blocks' terms, 36 each. */
#ifndef RTID_EST_TILES_PER_TICK
#ifdef RTID_ESTIMATOR_FLOAT32
#define RTID_EST_TILES_PER_TICK 11
#else
#define RTID_EST_TILES_PER_TICK 28
#endif
#endif
/* visits at once: blocks that ring, and as many that are settled or were visited again */
#define RTID_EST_MAX_VISITS (2 * RTID_EST_MAX_RECENT + RTID_EST_MAX_OPEN * (RTID_EST_MAX_OPEN + 4))
#define RTID_EST_SUMS ((1 + RTID_EST_UNKNOWNS) * (2 + RTID_EST_UNKNOWNS) / 2)

/* What became of samples; counts by these numbers. */
enum {
    RTID_EST_SAMPLES = 0, /* all */
    RTID_EST_ROWS,        /* measured positions that were learned from */
    RTID_EST_RESTART_GAP, /* a step back, too long, or announced by the sample */
    RTID_EST_NOT_FINITE,
    RTID_EST_OUT_OF_RANGE,
    RTID_EST_OUTSIDE_GRID,
    RTID_EST_BLOCK_CHANGES,
    RTID_EST_RESTART_MEMORY, /* too many blocks rang at once: all began anew */
    RTID_EST_RECOVERING,
    RTID_EST_NO_ROOM, /* a new block, and RTID_EST_MAX_BLOCKS are in use */
    RTID_EST_BUSY,    /* more changes of block than can be worked off: not learned from */
    RTID_EST_N_COUNTS,
    RTID_EST_TAKEN = -1
};

typedef struct {
    int64_t t_us; /* clock of the controller, 0 to 2^53 - 1 */
    uint8_t row;  /* x was measured at this instant */
    uint8_t gap;  /* samples before this one were lost */
    rtid_real values[RTID_EST_N_SIGNALS]; /* SI, V or A; in the order of rtid_estimator_tables.h */
} rtid_estimator_sample;

/* A block that was visited. */
typedef struct {
    int16_t edge, u, dp; /* place in the grid of its edge */
    uint64_t rows;
    int64_t dwell_us, last_us;
    rtid_sum phi[RTID_EST_TERMS]; /* integral of its terms over the time spent in it, s */
} rtid_estimator_block;

/* A visit to a block.  While it is open its column moves with every sample; behind that it rings in
 * the whitener as d x ring, whose ring all visits share; in the end it is silent, or is opened again
 * and goes on as another visit.  What it shares with a visit before it that rings is left' d of that
 * one; that is added to the sums when either changes, a few such tiles per tick. */
typedef struct {
    int16_t slot;
    uint8_t status;
    uint16_t memory;              /* visits of another memory share nothing with it */
    uint32_t epoch;               /* units of its numbers: 2^-epoch of the ring */
    rtid_real fade;               /* 2^(epoch - epoch of the ring) */
    rtid_real start;              /* ring when it closed, in units of its epoch */
    rtid_real d[RTID_EST_TERMS];  /* its state when the ring was 1 */
    rtid_sum left[RTID_EST_TERMS]; /* its column x ring while it was open */
    rtid_sum ring;                /* ring x ring since it closed */
    rtid_sum shared[RTID_EST_BLOCKS_AT]; /* ring x y and shared columns since it closed */
} rtid_estimator_visit;

typedef struct {
    int16_t edge, slot, visit, u, dp;
} rtid_estimator_open;

/* Products not yet added to the sums. */
typedef struct {
    rtid_sum local[RTID_EST_WIDTH][RTID_EST_WIDTH]; /* of the rows since the epoch began */
    uint16_t memory;
    int16_t n_open, n_line, n_paid, last_begun;
    uint32_t epoch;
    rtid_estimator_open open[RTID_EST_MAX_OPEN];
    rtid_estimator_visit visit[RTID_EST_MAX_VISITS];
    int16_t line[RTID_EST_MAX_VISITS]; /* closed visits, oldest first; the first one is settled
                                         * with the n_paid ones behind it */
} rtid_estimator_owed;

/* All that the estimator knows; begin with rtid_estimator_start.  A plain copy saves it. */
typedef struct {
    /* local columns, those that move at every sample */
    rtid_real d[RTID_EST_WIDTH];                    /* whitener's state of each column */
    int16_t width;
    rtid_real faded; /* of the ring's unit since the last look for silent blocks */
    rtid_estimator_owed owed;
    /* whitener */
    rtid_real cov, echo;
    rtid_sum noise;
    /* the last sample */
    int64_t t_us, ready_us, dt_us;
    rtid_real values[RTID_EST_N_SIGNALS + 1]; /* and a quantity that is always zero */
    rtid_real dt_s, lag_decay;
    uint8_t running;
    /* working points: lagged command, its mean and variance over the interval and its mean with
     * time, dp at both ends; the block, and the one that it is to be in */
    struct {
        rtid_real w, m1, var, mt, dp0, dp1;
        int16_t u, dp, to_u, to_dp, place;
    } edge[RTID_EST_N_EDGES];
    int16_t n_closed, n_slots, tiles; /* blocks that ring; tiles left in this tick */
    int16_t slot[RTID_EST_N_CELLS];      /* of each cell of the grids, -1 before the first visit */
    rtid_estimator_block block[RTID_EST_MAX_BLOCKS];
    rtid_sum sums[RTID_EST_SUMS]; /* lower triangle, row by row, of [y | shared | blocks] */
#ifndef RTID_ESTIMATOR_FLOAT32
    double lost[RTID_EST_MAX_BLOCKS][RTID_EST_KEPT]; /* of the sums: what rounding took off */
#endif
    uint64_t counts[RTID_EST_N_COUNTS];
} rtid_estimator;

/* What is known of a visited block. */
enum { RTID_EST_LEARNING, RTID_EST_VALID, RTID_EST_STALE };
typedef struct {
    double theta[RTID_EST_TERMS]; /* m3/s, of the terms of eq. (6) */
    double mean_m3s, mean_sd_m3s; /* flow averaged over the data, and its standard deviation */
    double condition;             /* of the information on its terms */
    uint8_t status;
} rtid_estimator_map;

/* Sums as they were at one instant, and the room in which they are solved. */
typedef struct {
    double matrix[RTID_EST_SUMS];
    double scale[RTID_EST_UNKNOWNS], theta[RTID_EST_UNKNOWNS], basis[RTID_EST_UNKNOWNS];
    double noise, rows, cov_change;
    int64_t now_us;
    int16_t n_slots;
    rtid_estimator_owed owed;
    rtid_estimator_block block[RTID_EST_MAX_BLOCKS];
    rtid_estimator_map map[RTID_EST_MAX_BLOCKS];
} rtid_estimator_work;

typedef struct {
    /* [0]: 1 / beta in 1/Pa, then the shared terms in units of their scales in SI; 1 sigma */
    double shared[RTID_EST_SHARED], shared_sd[RTID_EST_SHARED];
    double rho;      /* residual variance in units of the declared noise: 1 when all is explained */
    double leverage; /* share of the pressure noise that the maps absorb */
    uint16_t raised; /* 0, or directions in which the sums were not definite */
    uint8_t finite;  /* 0: an absurd sample was let in, and nothing here holds */
} rtid_estimator_solution;

/* Release, chamber and project. */
extern const char rtid_estimator_version[];

/* Begin without knowledge. */
void rtid_estimator_start(rtid_estimator *e);

/* Take one sample: RTID_EST_TAKEN, or the reason against it, which is counted. */
int rtid_estimator_update(rtid_estimator *e, const rtid_estimator_sample *sample);

/* Copy the sums and what is owed to them: a plain copy; not while an update runs. */
void rtid_estimator_freeze(const rtid_estimator *e, rtid_estimator_work *w);

/* Solve what was frozen: w->map[0 .. w->n_slots - 1], whose place in the grid is in w->block, and
 * *s.  Takes nothing but w. */
void rtid_estimator_solve(rtid_estimator_work *w, rtid_estimator_solution *s);

#endif
