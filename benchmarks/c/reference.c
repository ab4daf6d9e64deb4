/* The joint estimator's hot path by hand: the integral form of rtid/kernels, one or two chambers.

   It works on the records of rtid/kernels/layout.py (layout.h is generated from them), takes the
   same samples and leaves the same sums; what each step means is said there.  Written as one would
   write C for this job: sums over fixed strides that gcc vectorises, rows in registers' reach,
   nothing per sample that depends on the number of blocks.                                       */

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "layout.h"

enum { ROW_FLAG = 1, GAP_FLAG = 2, SHUT = -1, LANES = 4 };
static const double RING_LOG_LIMIT = -4.0;

typedef struct {
    Engine *e;
    Cell *cells;
    Closed *closed;
    Block *blocks;
    Pair *pairs;
    int64_t max_closed, max_blocks, max_pairs;
} Tables;

typedef double Terms[TERMS][TERMS];

static int first_ring(const Engine *e) { return (int)(1 + e->n_shared + TERMS * e->n_open); }

static int local_width(const Engine *e)
{
    const int n = (first_ring(e) + (int)e->n_state + LANES - 1) / LANES * LANES;
    return n < MAX_LOCAL ? n : MAX_LOCAL;
}

/* ---- pairs of blocks: open addressing ---- */

static Pair *find_pair(Tables *t, int64_t low, int64_t high)
{
    const int64_t key = ((low + 1) << 32) | (high + 1), mask = t->max_pairs - 1;
    const int64_t mixed = (low * 73856093) ^ (high * 19349663);
    int64_t at = (mixed ^ (mixed >> 15)) & mask;
    for (; t->pairs[at].key != key; at = (at + 1) & mask)
        if (t->pairs[at].key == 0) {
            t->pairs[at].key = key;
            t->e->n_pairs++;
            break;
        }
    return &t->pairs[at];
}

static void add_pair(Tables *t, int64_t a, int64_t b, Terms product)
{
    Pair *pair = a < b ? find_pair(t, a, b) : find_pair(t, b, a);
    for (int i = 0; i < TERMS; i++)
        for (int j = 0; j < TERMS; j++) pair->gram[i][j] += a < b ? product[i][j] : product[j][i];
}

/* ---- local products to blocks, pairs and ring ---- */

static void flush_open(Tables *t, int k)
{
    Engine *e = t->e;
    Block *block = &t->blocks[e->open_slot[k]];
    const int first = (int)(1 + e->n_shared + TERMS * k);
    Terms product;
    for (int i = 0; i < TERMS; i++) {
        for (int j = 0; j < 1 + e->n_shared; j++) block->shared[i][j] += e->gram[first + i][j];
        for (int j = 0; j < TERMS; j++) block->gram[i][j] += e->gram[first + i][first + j];
    }
    for (int other = k + 1; other < e->n_open; other++) {
        const int second = (int)(1 + e->n_shared + TERMS * other);
        for (int i = 0; i < TERMS; i++) memcpy(product[i], &e->gram[first + i][second], sizeof product[i]);
        add_pair(t, e->open_slot[k], e->open_slot[other], product);
    }
}

static void flush_closed(Tables *t, const Closed *item)
{
    Engine *e = t->e;
    Block *block = &t->blocks[item->slot];
    const int ring = first_ring(e);
    for (int s = 0; s < e->n_state; s++)
        for (int i = 0; i < TERMS; i++)
            for (int j = 0; j < 1 + e->n_shared; j++)
                block->shared[i][j] += item->d[s][i] * e->gram[ring + s][j];
    for (int k = 0; k < e->n_open; k++) {
        const int first = (int)(1 + e->n_shared + TERMS * k);
        Terms product = {{0.0}};
        for (int s = 0; s < e->n_state; s++)
            for (int i = 0; i < TERMS; i++)
                for (int j = 0; j < TERMS; j++)
                    product[i][j] += item->d[s][i] * e->gram[ring + s][first + j];
        add_pair(t, item->slot, e->open_slot[k], product);
    }
}

static void flush_local(Tables *t)
{
    Engine *e = t->e;
    const int ring = first_ring(e), n = ring + (int)e->n_state;
    for (int i = 0; i < 1 + e->n_shared; i++)
        for (int j = 0; j < 1 + e->n_shared; j++) e->shared[i][j] += e->gram[i][j];
    for (int i = 0; i < e->n_state; i++)
        for (int j = 0; j < e->n_state; j++) e->ring_w[i][j] += e->gram[ring + i][ring + j];
    for (int k = 0; k < e->n_open; k++) flush_open(t, k);
    for (int c = 0; c < e->n_closed; c++) flush_closed(t, &t->closed[c]);
    for (int i = 0; i < n; i++) memset(e->gram[i], 0, (size_t)n * sizeof(double));
}

/* ---- closed blocks, which ring together ---- */

static void ring_product(const Engine *e, const Closed *a, const Closed *b,
                         const double since[MAX_STATE][MAX_STATE], Terms out)
{
    double weighted[MAX_STATE][TERMS] = {{0.0}};
    for (int s = 0; s < e->n_state; s++)
        for (int r = 0; r < e->n_state; r++)
            for (int j = 0; j < TERMS; j++)
                weighted[s][j] += (e->ring_w[s][r] - since[s][r]) * b->d[r][j];
    memset(out, 0, sizeof(Terms));
    for (int s = 0; s < e->n_state; s++)
        for (int i = 0; i < TERMS; i++)
            for (int j = 0; j < TERMS; j++) out[i][j] += a->d[s][i] * weighted[s][j];
}

static void flush_ring(Tables *t, int at, int first)
{
    Engine *e = t->e;
    const Closed *item = &t->closed[at];
    Block *own = &t->blocks[item->slot];
    Terms product;
    ring_product(e, item, item, item->w_start, product);
    for (int i = 0; i < TERMS; i++)
        for (int j = 0; j < TERMS; j++) own->gram[i][j] += product[i][j];
    for (int c = first; c < e->n_closed; c++) {
        if (c == at) continue;
        ring_product(e, item, &t->closed[c], t->closed[c > at ? c : at].w_start, product);
        add_pair(t, item->slot, t->closed[c].slot, product);
    }
}

static double largest(const Closed *item, int n_state)
{
    double size = 0.0;
    for (int s = 0; s < n_state; s++)
        for (int i = 0; i < TERMS; i++) size = fmax(size, fabs(item->d[s][i]));
    return size;
}

static void advance_closed(const Engine *e, Closed *item)
{
    const int ring = first_ring(e);
    double old[MAX_STATE][TERMS];
    memcpy(old, item->d, sizeof old);
    for (int s = 0; s < e->n_state; s++)
        for (int i = 0; i < TERMS; i++) {
            item->d[s][i] = 0.0;
            for (int r = 0; r < e->n_state; r++) item->d[s][i] += e->d[s][ring + r] * old[r][i];
        }
    memset(item->w_start, 0, sizeof item->w_start);
}

static void rebase(Tables *t)
{
    Engine *e = t->e;
    const int ring = first_ring(e);
    int kept = 0;
    for (int c = 0; c < e->n_closed; c++) flush_ring(t, c, c + 1);
    for (int c = 0; c < e->n_closed; c++) {
        advance_closed(e, &t->closed[c]);
        if (largest(&t->closed[c], (int)e->n_state) > e->ring_floor * t->closed[c].size) {
            if (kept != c) t->closed[kept] = t->closed[c];
            kept++;
        }
    }
    e->n_closed = kept;
    e->ring_log = 0.0;
    memset(e->ring_w, 0, sizeof e->ring_w);
    for (int s = 0; s < e->n_state; s++)
        for (int r = 0; r < e->n_state; r++) e->d[s][ring + r] = s == r;
}

static void remove_closed(Tables *t, int at)
{
    memmove(&t->closed[at], &t->closed[at + 1], sizeof(Closed) * (size_t)(t->e->n_closed - 1 - at));
    t->e->n_closed--;
}

static void close_block(Tables *t, int k)
{
    Engine *e = t->e;
    const int ring = first_ring(e), first = (int)(1 + e->n_shared + TERMS * k);
    Closed *item = &t->closed[e->n_closed];
    memset(item, 0, sizeof *item);
    item->slot = e->open_slot[k];
    memcpy(item->w_start, e->ring_w, sizeof item->w_start);
    const double *d0 = e->d[0], *d1 = e->d[1];
    const double det = e->n_state == 2 ? d0[ring] * d1[ring + 1] - d0[ring + 1] * d1[ring] : 1.0;
    for (int i = 0; i < TERMS; i++) {
        const double x = d0[first + i], y = d1[first + i];
        if (e->n_state == 1) {
            item->d[0][i] = x / d0[ring];
            item->size = fmax(item->size, fabs(x));
        } else {
            item->d[0][i] = (d1[ring + 1] * x - d0[ring + 1] * y) / det;
            item->d[1][i] = (d0[ring] * y - d1[ring] * x) / det;
            item->size = fmax(item->size, fmax(fabs(x), fabs(y)));
        }
    }
    if (item->size > 0.0) e->n_closed++;
}

/* ---- open blocks ---- */

static void open_block(Tables *t, int edge, int64_t slot)
{
    Engine *e = t->e;
    const int ring = first_ring(e);
    for (int s = 0; s < e->n_state; s++) {
        for (int r = (int)e->n_state - 1; r >= 0; r--) e->d[s][ring + TERMS + r] = e->d[s][ring + r];
        memset(&e->d[s][ring], 0, TERMS * sizeof(double));
    }
    e->open_edge[e->n_open] = edge;
    e->open_slot[e->n_open] = slot;
    e->place[edge] = e->n_open++;
    for (int c = 0; c < e->n_closed; c++)
        if (t->closed[c].slot == slot) {
            flush_ring(t, c, 0);
            for (int s = 0; s < e->n_state; s++)
                for (int i = 0; i < TERMS; i++)
                    for (int r = 0; r < e->n_state; r++)
                        e->d[s][ring + i] += e->d[s][ring + TERMS + r] * t->closed[c].d[r][i];
            remove_closed(t, c);
            break;
        }
}

static void drop_open(Engine *e, int k)
{
    const int ring = first_ring(e), first = (int)(1 + e->n_shared + TERMS * k), last = ring - TERMS;
    const int n = (int)e->n_state;
    for (int s = 0; s < n; s++) {
        memmove(&e->d[s][first], &e->d[s][last], TERMS * sizeof(double));
        for (int r = 0; r < n; r++) e->d[s][last + r] = e->d[s][ring + r];
        for (int j = last + n; j < MAX_LOCAL && j < ring + n + LANES; j++) e->d[s][j] = 0.0;
    }
    e->place[e->open_edge[k]] = -1;
    e->n_open--;
    if (k < e->n_open) {
        e->open_edge[k] = e->open_edge[e->n_open];
        e->open_slot[k] = e->open_slot[e->n_open];
        e->place[e->open_edge[k]] = k;
    }
}

static void forget_ring(Tables *t)
{
    Engine *e = t->e;
    flush_local(t);
    rebase(t);
    e->n_closed = 0;
    for (int s = 0; s < e->n_state; s++) memset(e->d[s], 0, (size_t)first_ring(e) * sizeof(double));
}

static void stop(Tables *t)
{
    Engine *e = t->e;
    if (e->running) {
        forget_ring(t);
        while (e->n_open > 0) drop_open(e, (int)e->n_open - 1);
    }
    for (int i = 0; i < e->n_edges; i++) e->cell[i][0] = SHUT;
    e->running = 0;
}

/* ---- one interval ---- */

static int locate(const double *border, int64_t n, double value)
{
    if (!(value >= border[0] && value <= border[n])) return -1;
    int low = 0, high = (int)n;
    while (high - low > 1) {
        const int mid = (low + high) / 2;
        if (value >= border[mid]) low = mid; else high = mid;
    }
    return low;
}

static int relocate(const double *border, int64_t n, double value, int64_t current, double hysteresis)
{
    if (current >= 0) {
        const double margin = hysteresis * (border[current + 1] - border[current]);
        if (value >= border[current] - margin && value <= border[current + 1] + margin) return (int)current;
    }
    return locate(border, n, value);
}

typedef struct {
    double m1, m2, mt, dp0, dp1;
    int u, dp;
} Point; /* working point of one edge over the interval, and the block it asks for */

static int working_points(Engine *e, const double *now, double dt, Point *points)
{
    const double k = e->lag_s / dt, decay = e->lag_decay;
    int inside = 1;
    for (int i = 0; i < e->n_edges; i++) {
        Point *p = &points[i];
        const double held = e->direction[i] * e->values[e->command[i]];
        p->m1 = held, p->m2 = held * held, p->mt = 0.0, p->u = SHUT, p->dp = 0;
        if (e->lag_s > 0.0) {
            const double g = e->w_v[i] - held, mean = k * (1.0 - decay);
            p->m1 = held + g * mean;
            p->m2 = held * held + 2.0 * held * g * mean + g * g * 0.5 * k * (1.0 - decay * decay);
            p->mt = g * (k * (mean - decay) - 0.5 * mean);
            e->w_v[i] = held + g * decay;
        } else
            e->w_v[i] = held;
        if (p->m1 <= e->safe_v[i]) continue;
        p->dp0 = e->values[e->source[i]] - e->values[e->sink[i]];
        p->dp1 = now[e->source[i]] - now[e->sink[i]];
        const int64_t before = e->cell[i][0] != SHUT ? e->cell[i][1] : SHUT;
        p->u = relocate(e->u_border[i], e->n_u[i], p->m1, e->cell[i][0], e->hysteresis);
        p->dp = relocate(e->dp_border[i], e->n_dp[i], 0.5 * (p->dp0 + p->dp1), before, e->hysteresis);
        if (p->u < 0 || p->dp < 0) inside = 0;
    }
    return inside;
}

static double position_noise(const Engine *e, int a, int b)
{
    double r = e->area_m2[a] * e->area_m2[b] * e->x_var_m2;
    if (a == b) {
        const double v = (e->v0_m3[a] + e->area_m2[a] * e->values[e->x_column]) * e->compliance[a];
        r += v * v * e->p_var_pa2[a];
    }
    return r;
}

static void start_whitener(Engine *e)
{
    for (int a = 0; a < e->n_chambers; a++)
        for (int b = 0; b < e->n_chambers; b++) e->cov[a][b] = position_noise(e, a, b);
}

static void prepare_change(Tables *t)
{
    if (t->e->n_closed + MAX_OPEN > t->max_closed) {
        t->e->counters[RESTART_MEMORY]++;
        forget_ring(t);
        start_whitener(t->e);
    } else
        flush_local(t);
}

static int64_t slot_of(Tables *t, int edge)
{
    Engine *e = t->e;
    const int64_t at = e->first_cell[edge] + e->cell[edge][0] * e->n_dp[edge] + e->cell[edge][1];
    if (t->cells[at].slot < 0) {
        t->cells[at].slot = e->n_slots;
        t->blocks[e->n_slots].cell = at;
        t->blocks[e->n_slots].edge = edge;
        e->n_slots++;
    }
    return t->cells[at].slot;
}

static void change_blocks(Tables *t, const Point *points)
{
    Engine *e = t->e;
    int flushed = 0;
    for (int i = 0; i < e->n_edges; i++) {
        const Point *p = &points[i];
        if (p->u == e->cell[i][0] && (p->u == SHUT || p->dp == e->cell[i][1])) continue;
        if (!flushed++) prepare_change(t);
        e->counters[BLOCK_CHANGES]++;
        if (e->place[i] >= 0) {
            const int k = (int)e->place[i];
            close_block(t, k);
            drop_open(e, k);
        }
        e->cell[i][0] = p->u, e->cell[i][1] = p->dp;
        if (p->u != SHUT) open_block(t, i, slot_of(t, i));
    }
}

static void shared_increments(Engine *e, const double *now)
{
    const double x0 = e->values[e->x_column], x1 = now[e->x_column];
    for (int c = 0; c < e->n_chambers; c++) {
        const double dp = now[e->p_column[c]] - e->values[e->p_column[c]];
        e->d[c][0] += e->area_m2[c] * (x1 - x0);
        e->d[c][1 + c] -= (e->v0_m3[c] + 0.5 * e->area_m2[c] * (x0 + x1)) * e->compliance[c] * dp;
    }
}

static void block_increments(Tables *t, int k, double time_s, double dt, const Point *points, int row)
{
    Engine *e = t->e;
    const int i = (int)e->open_edge[k], first = (int)(1 + e->n_shared + TERMS * k);
    const Point *w = &points[i];
    Block *block = &t->blocks[e->open_slot[k]];
    const double *u = &e->u_border[i][e->cell[i][0]], *p = &e->dp_border[i][e->cell[i][1]];
    const double hu = 2.0 / (u[1] - u[0]), hp = 2.0 / (p[1] - p[0]);
    const double uc = 0.5 * (u[1] + u[0]), pc = 0.5 * (p[1] + p[0]);
    const double xi = (w->m1 - uc) * hu, eta0 = (w->dp0 - pc) * hp, eta1 = (w->dp1 - pc) * hp;
    const double eta = 0.5 * (eta0 + eta1);
    const double phi[TERMS] = {
        1.0, xi, eta, (w->m2 - 2.0 * uc * w->m1 + uc * uc) * hu * hu,
        (eta0 * eta0 + eta0 * eta1 + eta1 * eta1) / 3.0, xi * eta + w->mt * hu * (eta1 - eta0)};
    block->dwell_s += dt;
    block->last_s = time_s;
    block->rows += row != 0;
    for (int j = 0; j < TERMS; j++) block->phi_sum[j] += phi[j] * dt;
    const double slope = t->cells[block->cell].slope;
    const double q = slope * slope * e->dp_var_pa2[i] * (e->p_period_s > 0.0 ? e->p_period_s : dt) * dt;
    for (int c = 0; c < e->n_chambers; c++) {
        const double scale = e->sign[i][c] * e->scale_m3s[i] * dt;
        for (int j = 0; j < TERMS; j++) e->d[c][first + j] += scale * phi[j];
        for (int b = 0; b < e->n_chambers; b++) e->cov[c][b] += e->sign[i][c] * e->sign[i][b] * q;
    }
}

/* ---- rows: Kalman whitener and products ---- */

static void row_one(Engine *e)
{
    const int n = local_width(e);
    const double r = position_noise(e, 0, 0), s = e->cov[0][0] + r;
    const double scale = 1.0 / sqrt(s), keep = r / s;
    double *restrict d = e->d[0], row[MAX_LOCAL];
    for (int j = 0; j < n; j++) {
        row[j] = scale * d[j];
        d[j] *= keep;
    }
    const double v = (e->v0_m3[0] + e->area_m2[0] * e->values[e->x_column]) * e->compliance[0];
    e->noise_gram[0] += v * v * e->p_var_pa2[0] / s;
    e->cov[0][0] *= keep;
    e->ring_log += log(keep);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) e->gram[i][j] += row[i] * row[j];
}

static void row_two(Engine *e)
{
    const int n = local_width(e);
    const double r00 = position_noise(e, 0, 0), r01 = position_noise(e, 0, 1), r11 = position_noise(e, 1, 1);
    const double p00 = e->cov[0][0], p01 = e->cov[0][1], p11 = e->cov[1][1];
    const double s00 = p00 + r00, s01 = p01 + r01, s11 = p11 + r11;
    const double i0 = 1.0 / sqrt(s00), c = s01 * i0, i1 = 1.0 / sqrt(s11 - c * c), ci0 = c * i0;
    const double det = 1.0 / (s00 * s11 - s01 * s01);
    const double k00 = (r00 * s11 - r01 * s01) * det, k01 = (r01 * s00 - r00 * s01) * det;
    const double k10 = (r01 * s11 - r11 * s01) * det, k11 = (r11 * s00 - r01 * s01) * det;
    double *restrict d0 = e->d[0], *restrict d1 = e->d[1], row0[MAX_LOCAL], row1[MAX_LOCAL];
    for (int j = 0; j < n; j++) {
        const double x = d0[j], y = d1[j];
        row0[j] = i0 * x;
        row1[j] = i1 * (y - ci0 * x);
        d0[j] = k00 * x + k01 * y;
        d1[j] = k10 * x + k11 * y;
    }
    const double v0 = (e->v0_m3[0] + e->area_m2[0] * e->values[e->x_column]) * e->compliance[0];
    const double v1 = (e->v0_m3[1] + e->area_m2[1] * e->values[e->x_column]) * e->compliance[1];
    e->noise_gram[0] += v0 * v0 * e->p_var_pa2[0] * s11 * det;
    e->noise_gram[1] += v1 * v1 * e->p_var_pa2[1] * s00 * det;
    e->cov[0][0] = k00 * p00 + k01 * p01;
    e->cov[1][1] = k10 * p01 + k11 * p11;
    e->cov[0][1] = e->cov[1][0] = 0.5 * (k00 * p01 + k01 * p11 + k10 * p00 + k11 * p01);
    e->ring_log += log(k00 * k11 - k01 * k10);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) e->gram[i][j] += row0[i] * row0[j] + row1[i] * row1[j];
}

static void interval(Tables *t, double time_s, const double *now, double dt, int row)
{
    Engine *e = t->e;
    Point points[MAX_EDGES];
    if (dt != e->dt_s) {
        e->dt_s = dt;
        e->lag_decay = e->lag_s > 0.0 ? exp(-dt / e->lag_s) : 0.0;
    }
    if (!working_points(e, now, dt, points)) {
        e->counters[OUTSIDE_GRID]++;
        stop(t);
        return;
    }
    change_blocks(t, points);
    shared_increments(e, now);
    for (int k = 0; k < e->n_open; k++) block_increments(t, k, time_s, dt, points, row);
    memcpy(e->values, now, (size_t)e->n_signals * sizeof(double));
    for (int c = 0; c < e->n_chambers; c++) e->cov[c][c] += e->q_floor[c] * dt;
    if (row) {
        e->counters[ROWS]++;
        if (e->n_chambers == 2) row_two(e); else row_one(e);
        if (e->ring_log < RING_LOG_LIMIT) {
            flush_local(t);
            rebase(t);
        }
    }
}

/* ---- samples ---- */

static int acceptable(Engine *e, const double *sample)
{
    for (int j = 0; j < 2 + e->n_signals; j++)
        if (!isfinite(sample[j])) {
            e->counters[NOT_FINITE]++;
            return 0;
        }
    for (int j = 0; j < e->n_signals; j++)
        if (sample[2 + j] < e->minimum[j] || sample[2 + j] > e->maximum[j]) {
            e->counters[OUT_OF_RANGE]++;
            return 0;
        }
    return 1;
}

static void start(Engine *e, double time_s, const double *now)
{
    memcpy(e->values, now, (size_t)e->n_signals * sizeof(double));
    e->running = 1;
    e->next_row_s = time_s + e->row_period_s;
    for (int i = 0; i < e->n_edges; i++) e->w_v[i] = e->direction[i] * e->values[e->command[i]];
    start_whitener(e);
}

static void take(Tables *t, const double *sample)
{
    Engine *e = t->e;
    const int flags = (int)sample[1];
    const double dt = sample[0] - e->t_s, *now = sample + 2;
    e->counters[SAMPLES]++;
    if (!acceptable(e, sample)) {
        stop(t);
        return;
    }
    if (e->running && ((flags & GAP_FLAG) || dt > e->max_gap_s || dt <= 0.0)) {
        e->counters[RESTART_GAP]++;
        stop(t);
    }
    if (e->running) interval(t, sample[0], now, dt, flags & ROW_FLAG);
    else if (flags & ROW_FLAG) start(e, sample[0], now);
    e->t_s = sample[0];
    memcpy(e->values, now, (size_t)e->n_signals * sizeof(double));
}

/* chunk (n, width): [t_s, flags, values...]; returns the samples taken before a table was full. */
int64_t advance(Engine *e, Cell *cells, Closed *closed, int64_t max_closed, Block *blocks,
                int64_t max_blocks, Pair *pairs, int64_t max_pairs, const double *chunk, int64_t n)
{
    Tables t = {e, cells, closed, blocks, pairs, max_closed, max_blocks, max_pairs};
    for (int64_t k = 0; k < n; k++) {
        const int64_t ringing = e->n_closed + MAX_OPEN;
        if (e->n_slots + MAX_EDGES > max_blocks ||
            10 * (e->n_pairs + ringing * ringing / 2) > 6 * max_pairs)
            return k;
        take(&t, chunk + k * (2 + e->n_signals));
    }
    return n;
}
