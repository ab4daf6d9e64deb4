/* One interval between two samples: the blocks of its working points, what it adds to the columns of
 * eq. (14), and the row at its end; see rtid/kernels/engine.py, increments.py and rows.py. */
#include "rtid_estimator_sums.h"

/* ---- the machine: constants that the generated tables name ---- */

typedef struct {
    uint8_t source, sink, command; /* columns of the sample; RTID_EST_N_SIGNALS: always zero */
    rtid_real direction, safe, sign, scale, dp_var;
    uint8_t n_u, n_dp, masked;
    uint16_t first_u, first_dp, first_cell; /* rows of BORDERS and CELLS */
    rtid_real mask[T];                      /* 1 for the terms that its map has, eq. (15) */
} edge_row;

typedef struct {
    rtid_real slope, missed; /* nominal dQ/ddp; variance rate of what six terms miss, m6/s */
} cell_row;

enum { LINEAR, SIGNED_ROOT, HINGE, INVERSE };

typedef struct {
    uint8_t shape, rate, volume; /* rate: - V df/dt, V the chamber's volume or 1 */
    rtid_real scale, sign, constant, weight[RTID_EST_N_SIGNALS];
} term_row;

static const edge_row EDGES[] = {RTID_EST_EDGE_ROWS};
static const rtid_real BORDERS[] = {RTID_EST_BORDERS};
static const cell_row CELLS[] = {RTID_EST_CELL_ROWS};
#if RTID_EST_N_TERMS > 0
static const term_row TERMS[] = {RTID_EST_TERM_ROWS};
#endif
static const rtid_real AREA = R(RTID_EST_AREA), V0 = R(RTID_EST_V0), X_VAR = R(RTID_EST_X_VAR),
                       P_VAR = R(RTID_EST_P_VAR), COMPLIANCE = R(RTID_EST_COMPLIANCE),
                       Q_FLOOR = R(RTID_EST_Q_FLOOR), P_PERIOD = R(RTID_EST_P_PERIOD),
                       HYSTERESIS = R(RTID_EST_HYSTERESIS), LAG = R(RTID_EST_LAG);

double rtid_est_rated(int edge) { return EDGES[edge].scale; }

bool rtid_est_has_term(int edge, int term) { return EDGES[edge].mask[term] > 0; }

double rtid_est_shared_scale(int shared)
{
#if RTID_EST_N_TERMS > 0
    if (shared > 0) {
        return TERMS[shared - 1].scale;
    }
#endif
    (void)shared;
    return RTID_EST_COMPLIANCE;
}

static rtid_real volume(rtid_real x) { return V0 + (AREA * x); }

/* ---- one interval ---- */

static int locate(const rtid_real *border, int n, rtid_real value)
{
    int low = 0, high = n;
    if (!((value >= border[0]) && (value <= border[n]))) {
        return -1;
    }
    while ((high - low) > 1) {
        const int mid = (low + high) / 2;
        if (value >= border[mid]) {
            low = mid;
        } else {
            high = mid;
        }
    }
    return low;
}

/* As locate, but stay in `current` until value leaves it by a share of its width. */
static int relocate(const rtid_real *border, int n, rtid_real value, int current)
{
    if (current >= 0) {
        const rtid_real margin = HYSTERESIS * (border[current + 1] - border[current]);
        if ((value >= (border[current] - margin)) && (value <= (border[current + 1] + margin))) {
            return current;
        }
    }
    return locate(border, n, value);
}

static rtid_real commanded(const rtid_estimator *e, int i)
{
    return EDGES[i].direction * e->values[EDGES[i].command];
}

static void set_step(rtid_estimator *e, int64_t dt_us)
{
    e->dt_us = dt_us;
    e->dt_s = R((double)dt_us * 1e-6);
    e->lag_decay = (LAG > R(0)) ? EXP(-e->dt_s / LAG) : R(0);
}

/* Lagged command of edge i over the interval: its end value and moments. */
static void follow_command(rtid_estimator *e, int i)
{
    const rtid_real held = commanded(e, i), k = LAG / e->dt_s, decay = e->lag_decay;
    const rtid_real g = e->edge[i].w - held, mean = k * (R(1) - decay);
    e->edge[i].w = held;
    e->edge[i].m1 = held;
    e->edge[i].var = 0;
    e->edge[i].mt = 0;
    if (!(LAG > R(0))) {
        return;
    }
    e->edge[i].w = held + (g * decay);
    e->edge[i].m1 = held + (g * mean);
    e->edge[i].var = g * g * ((R(0.5) * k * (R(1) - (decay * decay))) - (mean * mean));
    e->edge[i].mt = g * ((k * (mean - decay)) - (R(0.5) * mean));
}

static bool moved(const rtid_estimator *e, int i)
{
    return (e->edge[i].to_u != e->edge[i].u)
           || ((e->edge[i].to_u != SHUT) && (e->edge[i].to_dp != e->edge[i].dp));
}

static rtid_real read(const rtid_real *values, int column)
{
    return (column < RTID_EST_N_SIGNALS) ? values[column] : R(0);
}

/* Find the block that each edge asks for; false where one is off its grid. */
static bool working_points(rtid_estimator *e, const rtid_real *now)
{
    bool inside = true;
    for (int i = 0; i < RTID_EST_N_EDGES; i++) {
        const edge_row *row = &EDGES[i];
        const int before = (e->edge[i].u != SHUT) ? e->edge[i].dp : SHUT;
        rtid_real mid;
        int u, dp;
        follow_command(e, i);
        e->edge[i].to_u = SHUT;
        e->edge[i].to_dp = e->edge[i].dp;
        if (!(e->edge[i].m1 > row->safe)) {
            continue;
        }
        e->edge[i].dp0 = e->values[row->source] - e->values[row->sink];
        e->edge[i].dp1 = read(now, row->source) - read(now, row->sink);
        u = relocate(&BORDERS[row->first_u], row->n_u, e->edge[i].m1, e->edge[i].u);
        mid = R(0.5) * (e->edge[i].dp0 + e->edge[i].dp1);
        dp = relocate(&BORDERS[row->first_dp], row->n_dp, mid, before);
        e->edge[i].to_u = (int16_t)u;
        e->edge[i].to_dp = (int16_t)dp;
        inside = inside && (u >= 0) && (dp >= 0);
    }
    return inside;
}

static int cell_of(int i, int u, int dp) { return (int)EDGES[i].first_cell + (u * (int)EDGES[i].n_dp) + dp; }

/* Every block that is asked for has a slot or finds one. */
static bool has_room(const rtid_estimator *e)
{
    int wanted = e->n_slots;
    for (int i = 0; i < RTID_EST_N_EDGES; i++) {
        if (e->edge[i].to_u != SHUT) {
            wanted += (e->slot[cell_of(i, e->edge[i].to_u, e->edge[i].to_dp)] < 0) ? 1 : 0;
        }
    }
    return wanted <= RTID_EST_MAX_BLOCKS;
}

static int slot_of(rtid_estimator *e, int i)
{
    int16_t *slot = &e->slot[cell_of(i, e->edge[i].u, e->edge[i].dp)];
    if (*slot < 0) {
        rtid_estimator_block *block = &e->block[e->n_slots];
        block->edge = (int16_t)i;
        block->u = e->edge[i].u;
        block->dp = e->edge[i].dp;
        *slot = e->n_slots;
        e->n_slots++;
    }
    return *slot;
}

static void change_block(rtid_estimator *e, int i)
{
    const int place = e->edge[i].place;
    const bool was_open = place >= 0;
    e->counts[RTID_EST_BLOCK_CHANGES]++;
    e->edge[i].u = e->edge[i].to_u;
    e->edge[i].dp = e->edge[i].to_dp;
    if (was_open) {
        rtid_est_close(e, place);
    }
    if (e->edge[i].u != SHUT) {
        rtid_est_open(e, was_open ? place : (int)e->owed.n_open, i, slot_of(e, i));
    } else if (was_open) {
        rtid_est_remove_open(e, place);
    } else {
        /* it was shut before */
    }
}

#if RTID_EST_N_TERMS > 0
static rtid_real argument(const term_row *row, const rtid_real *values)
{
    rtid_real z = row->constant;
    for (int j = 0; j < RTID_EST_N_SIGNALS; j++) {
        z += row->weight[j] * values[j];
    }
    return z;
}

static rtid_real shaped(const term_row *row, const rtid_real *values)
{
    rtid_real z = argument(row, values);
    switch (row->shape) {
    case SIGNED_ROOT: z = (z < R(0)) ? -ROOT(-z) : ROOT(z); break;
    case HINGE: z = (z > R(0)) ? z : R(0); break;
    case INVERSE: z = R(-1) / z; break;
    default: break; /* LINEAR */
    }
    return z;
}
#endif

#if RTID_EST_SOFT_TERMS > 0
static const rtid_real LEAST_Z = R(1e-12); /* below which a root is no steeper */

static rtid_real steepness(const term_row *row, const rtid_real *values)
{
    const rtid_real z = argument(row, values), size = (z < R(0)) ? -z : z;
    rtid_real slope = R(1);
    switch (row->shape) {
    case SIGNED_ROOT: slope = R(0.5) / ROOT((size > LEAST_Z) ? size : LEAST_Z); break;
    case HINGE: slope = (z > R(0)) ? R(1) : R(0); break;
    case INVERSE: slope = R(1) / (z * z); break;
    default: break; /* LINEAR */
    }
    return slope;
}

/* What the rate terms, at theta = 1, store per pressure of the chamber: V scale df/dp. */
static rtid_real softness(const rtid_estimator *e)
{
    rtid_real sum = R(0);
    for (int k = 0; k < RTID_EST_N_TERMS; k++) {
        const term_row *row = &TERMS[k];
        const rtid_real weight = row->weight[RTID_EST_P];
        if ((row->rate != 0u) && (weight != R(0))) {
            const rtid_real v = (row->volume != 0u) ? volume(e->values[RTID_EST_X]) : R(1);
            sum += row->sign * row->scale * weight * v * steepness(row, e->values);
        }
    }
    return sum;
}
#endif

static rtid_real column_variance(const rtid_estimator *e)
{
    const rtid_real w = volume(e->values[RTID_EST_X]) * COMPLIANCE;
    return w * w * P_VAR;
}

static rtid_real position_noise(const rtid_estimator *e)
{
    rtid_real stored = volume(e->values[RTID_EST_X]) * COMPLIANCE;
#if RTID_EST_SOFT_TERMS > 0
    stored += softness(e);
#endif
    return (AREA * AREA * X_VAR) + (stored * stored * P_VAR);
}

static void start_whitener(rtid_estimator *e)
{
    e->echo = 0;
    e->cov = position_noise(e);
}

/* Edges that shut come first, or a reversal could exceed the places for open blocks. */
static void change_blocks(rtid_estimator *e)
{
    if ((e->owed.n_open + e->n_closed + RTID_EST_MAX_OPEN) > RTID_EST_MAX_RECENT) {
        e->counts[RTID_EST_RESTART_MEMORY]++;
        rtid_est_end(e);
        start_whitener(e);
    }
    for (int opening = 0; opening < 2; opening++) {
        for (int i = 0; i < RTID_EST_N_EDGES; i++) {
            if (((e->edge[i].to_u != SHUT) == (opening > 0)) && moved(e, i)) {
                change_block(e, i);
            }
        }
    }
}

int rtid_est_place(rtid_estimator *e, const rtid_real *now, int64_t dt_us)
{
    bool any = false;
    if (dt_us != e->dt_us) {
        set_step(e, dt_us);
    }
    if (!working_points(e, now)) {
        return RTID_EST_OUTSIDE_GRID;
    }
    if (!has_room(e)) {
        return RTID_EST_NO_ROOM;
    }
    for (int i = 0; i < RTID_EST_N_EDGES; i++) {
        any = any || moved(e, i);
    }
    if (any && rtid_est_is_full(e)) {
        return RTID_EST_BUSY;
    }
    if (any) {
        change_blocks(e);
    }
    return RTID_EST_TAKEN;
}

static void shared_increments(rtid_estimator *e, const rtid_real *now)
{
    const rtid_real x0 = e->values[RTID_EST_X], x1 = now[RTID_EST_X];
    e->d[0] += AREA * (x1 - x0);
#ifdef RTID_EST_P
    e->d[1] -= R(0.5) * (volume(x0) + volume(x1))
               * (COMPLIANCE * (now[RTID_EST_P] - e->values[RTID_EST_P]));
#endif
}

#if RTID_EST_N_TERMS > 0
static void term_increments(rtid_estimator *e, const rtid_real *now)
{
    for (int k = 0; k < RTID_EST_N_TERMS; k++) {
        const term_row *row = &TERMS[k];
        const rtid_real start = shaped(row, e->values), end = shaped(row, now);
        rtid_real sum = e->dt_s * (start + end);
        if (row->rate != 0u) {
            sum = R(-2) * (end - start);
            if (row->volume != 0u) {
                sum *= R(0.5) * (volume(e->values[RTID_EST_X]) + volume(now[RTID_EST_X]));
            }
        }
        e->d[2 + k] += R(0.5) * row->sign * row->scale * sum;
    }
}
#endif

/* Means over the interval of the six terms of an open block, exact for the lag and linear dp. */
static void mean_terms(const rtid_estimator *e, const rtid_estimator_open *open, rtid_real *phi)
{
    const int i = open->edge;
    const rtid_real *u = &BORDERS[(int)EDGES[i].first_u + open->u];
    const rtid_real *p = &BORDERS[(int)EDGES[i].first_dp + open->dp];
    const rtid_real hu = R(2) / (u[1] - u[0]), hp = R(2) / (p[1] - p[0]);
    const rtid_real uc = R(0.5) * (u[1] + u[0]), pc = R(0.5) * (p[1] + p[0]);
    const rtid_real eta0 = (e->edge[i].dp0 - pc) * hp, eta1 = (e->edge[i].dp1 - pc) * hp;
    phi[0] = R(1);
    phi[1] = (e->edge[i].m1 - uc) * hu;
    phi[2] = R(0.5) * (eta0 + eta1);
    phi[3] = (phi[1] * phi[1]) + (e->edge[i].var * hu * hu); /* local: no digits are lost in float */
    phi[4] = ((eta0 * eta0) + (eta0 * eta1) + (eta1 * eta1)) * R(1.0 / 3.0);
    phi[5] = (phi[1] * phi[2]) + (e->edge[i].mt * hu * (eta1 - eta0));
    if (EDGES[i].masked != 0u) {
        for (int j = 0; j < T; j++) {
            phi[j] *= EDGES[i].mask[j];
        }
    }
}

static void block_increments(rtid_estimator *e, int k, const rtid_estimator_sample *sample)
{
    const rtid_estimator_open *open = &e->owed.open[k];
    rtid_estimator_block *block = &e->block[open->slot];
    const edge_row *edge = &EDGES[open->edge];
    const cell_row *cell = &CELLS[cell_of(open->edge, open->u, open->dp)];
    const rtid_real scale = edge->sign * edge->scale * e->dt_s;
    const rtid_real period = (P_PERIOD > R(0)) ? P_PERIOD : e->dt_s;
    rtid_real phi[T];
    mean_terms(e, open, phi);
    block->dwell_us += e->dt_us;
    block->last_us = sample->t_us;
    block->rows += (sample->row != 0u) ? 1u : 0u;
    for (int j = 0; j < T; j++) {
        merge(&block->phi[j], as_sum(phi[j] * e->dt_s));
        e->d[first_of(k) + j] += scale * phi[j];
    }
    /* random walk of the integral: pressure noise through dQ/ddp and missed flow */
    e->cov += ((cell->slope * cell->slope * edge->dp_var * period) + cell->missed) * e->dt_s;
}

/* Products of the columns of a row, three lines of their triangle at a time: most of a tick. */
static void add_row(rtid_sum (*local)[RTID_EST_WIDTH], const rtid_real *row, int n)
{
    int i = 0;
    while ((i + 3) <= n) {
        rtid_sum *first = local[i], *second = local[i + 1], *third = local[i + 2];
        const rtid_real a = row[i], b = row[i + 1], c = row[i + 2];
        for (int j = 0; j <= i; j++) {
            const rtid_real x = row[j];
            add_product(&first[j], a, x);
            add_product(&second[j], b, x);
            add_product(&third[j], c, x);
        }
        add_product(&second[i + 1], b, b);
        add_product(&third[i + 1], c, b);
        add_product(&third[i + 2], c, c);
        i += 3;
    }
    while (i < n) {
        for (int j = 0; j <= i; j++) {
            add_product(&local[i][j], row[i], row[j]);
        }
        i++;
    }
}

/* A row of all columns and their decay, by the Kalman whitener; see rtid/kernels/rows.py. */
static void make_row(rtid_estimator *e)
{
    const rtid_real v = column_variance(e), r = position_noise(e), s = e->cov + r;
    const rtid_real scale = R(1) / ROOT(s), keep = r / s, lost = R(1) - keep;
    const int n = e->width;
    rtid_real row[RTID_EST_WIDTH];
    for (int j = 0; j < n; j++) {
        row[j] = scale * e->d[j];
        e->d[j] *= keep;
    }
    add_row(e->owed.local, row, n);
    merge(&e->noise, as_sum((v + e->echo) / s));
    e->echo = (keep * keep * e->echo) + (lost * lost * v);
    e->cov *= keep;
    e->counts[RTID_EST_ROWS]++;
}

void rtid_est_integrate(rtid_estimator *e, const rtid_estimator_sample *sample)
{
    shared_increments(e, sample->values);
#if RTID_EST_N_TERMS > 0
    term_increments(e, sample->values);
#endif
    for (int k = 0; k < e->owed.n_open; k++) {
        block_increments(e, k, sample);
    }
    rtid_est_remember(e, sample);
    e->cov += Q_FLOOR * e->dt_s;
    if (sample->row != 0u) {
        make_row(e);
    }
    if ((e->faded * e->d[RTID_EST_RING]) < FORGET_AT) {
        rtid_est_forget(e);
    }
    if (e->d[RTID_EST_RING] < RING_LIMIT) {
        rtid_est_renew(e);
    }
}

void rtid_est_begin(rtid_estimator *e)
{
    e->running = 1u;
    for (int i = 0; i < RTID_EST_N_EDGES; i++) {
        e->edge[i].w = commanded(e, i);
    }
    start_whitener(e);
}
