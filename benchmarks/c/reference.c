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
static const double RING_DET_LIMIT = 1e-3;

typedef struct {
    Engine *e;
    Cell *cells;
    Closed *closed;
    Block *blocks;
    Pair *pairs;
    int64_t max_closed, max_blocks, max_pairs;
} Tables;

typedef double State[MAX_STATE][TERMS];
typedef double Row[TERMS * MAX_RECENT];

static int first_open(const Engine *e, int64_t k) { return (int)(e->first + TERMS * k); }

static void set_open(Engine *e, int n)
{
    const int width = (first_open(e, n) + LANES - 1) / LANES * LANES;
    e->n_open = n;
    e->width = width < MAX_LOCAL ? width : MAX_LOCAL;
}

/* an entry of the local products, which stand in the lower triangle */
static double local(const Engine *e, int i, int j) { return i > j ? e->gram[i][j] : e->gram[j][i]; }

static double ring_ring(const Engine *e, int s, int r)
{
    return local(e, (int)e->ring + s, (int)e->ring + r);
}

/* ---- recent blocks: a dense matrix, and the tables of blocks and pairs ---- */

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

static void hand_over(Tables *t, int p)
{
    Closed *item = &t->closed[p];
    Block *own = &t->blocks[item->slot];
    for (int i = 0; i < TERMS; i++)
        for (int j = 0; j < TERMS; j++) {
            own->gram[i][j] += item->gram[i][TERMS * p + j];
            item->gram[i][TERMS * p + j] = 0.0;
        }
    for (int q = 0; q < t->e->n_recent; q++) {
        if (t->closed[q].status == FREE || q == p) continue;
        const int a = item->slot < t->closed[q].slot ? p : q, b = p + q - a;
        Closed *low = &t->closed[a], *high = &t->closed[b];
        Pair *pair = find_pair(t, low->slot, high->slot);
        for (int i = 0; i < TERMS; i++)
            for (int j = 0; j < TERMS; j++) {
                pair->gram[i][j] += low->gram[i][TERMS * b + j];
                pair->gram[i][j] += high->gram[j][TERMS * a + i];
                low->gram[i][TERMS * b + j] = high->gram[j][TERMS * a + i] = 0.0;
            }
    }
}

static void release(Tables *t, int p)
{
    Engine *e = t->e;
    hand_over(t, p);
    t->closed[p].status = FREE;
    for (int s = 0; s < e->n_state; s++) memset(&e->ringing[s][TERMS * p], 0, TERMS * sizeof(double));
    while (e->n_recent > 0 && t->closed[e->n_recent - 1].status == FREE) e->n_recent--;
}

static int admit(Tables *t, int64_t slot)
{
    int p = 0;
    while (p < t->e->n_recent && t->closed[p].status != FREE) p++;
    if (p + 1 > t->e->n_recent) t->e->n_recent = p + 1;
    t->closed[p].status = OPEN;
    t->closed[p].slot = slot;
    return p;
}

static void spread(const Engine *e, Closed *item, const State left, const Row *restrict right, int count)
{
    for (int i = 0; i < TERMS; i++) {
        double *restrict target = item->gram[i];
        const double a = left[0][i], b = left[1][i];
        if (e->n_state == 2)
            for (int j = 0; j < count; j++) target[j] += a * right[0][j] + b * right[1][j];
        else
            for (int j = 0; j < count; j++) target[j] += a * right[0][j];
    }
}

static void add_tile(const Engine *e, Closed *item, int64_t p, const State left, const State right)
{
    for (int s = 0; s < e->n_state; s++)
        for (int i = 0; i < TERMS; i++)
            for (int j = 0; j < TERMS; j++) item->gram[i][TERMS * p + j] += left[s][i] * right[s][j];
}

/* ---- products of one block ---- */

static void read_through(const Engine *e, int k, double sign, State out)
{
    const int ring = (int)e->ring, first = first_open(e, k);
    for (int s = 0; s < e->n_state; s++)
        for (int i = 0; i < TERMS; i++) out[s][i] = sign * e->gram[first + i][ring + s];
}

static void add_own(Tables *t, int k)
{
    Engine *e = t->e;
    const int p = (int)e->open_recent[k], first = first_open(e, k);
    Closed *item = &t->closed[p];
    Block *block = &t->blocks[e->open_slot[k]];
    for (int i = 0; i < TERMS; i++) {
        for (int j = 0; j < 1 + e->n_shared; j++) block->shared[i][j] += e->gram[first + i][j];
        for (int j = 0; j < TERMS; j++) item->gram[i][TERMS * p + j] += local(e, first + i, first + j);
    }
}

static void add_open_pair(Tables *t, int k, int other)
{
    Engine *e = t->e;
    const int a = k > other ? k : other, b = k + other - a;
    Closed *item = &t->closed[e->open_recent[a]];
    const int at = (int)(TERMS * e->open_recent[b]), first = first_open(e, a), second = first_open(e, b);
    for (int i = 0; i < TERMS; i++)
        for (int j = 0; j < TERMS; j++) item->gram[i][at + j] += e->gram[first + i][second + j];
}

static void weigh(const Engine *e, const Closed *item, State own, State left)
{
    memset(own, 0, sizeof(State));
    for (int s = 0; s < e->n_state; s++) {
        for (int r = 0; r < e->n_state; r++) {
            const double w = ring_ring(e, s, r) - item->w_start[s][r];
            for (int i = 0; i < TERMS; i++) own[s][i] += w * item->d[r][i];
        }
        for (int i = 0; i < TERMS; i++) left[s][i] = item->through[s][i] + own[s][i];
    }
}

static void add_shared(Tables *t, const Closed *item)
{
    const Engine *e = t->e;
    Block *block = &t->blocks[item->slot];
    for (int s = 0; s < e->n_state; s++)
        for (int j = 0; j < 1 + e->n_shared; j++) {
            const double value = e->gram[(int)e->ring + s][j] - item->shared_start[s][j];
            for (int i = 0; i < TERMS; i++) block->shared[i][j] += item->d[s][i] * value;
        }
}

/* ---- changes of block ---- */

static void clear_open(Engine *e, int k)
{
    const int first = first_open(e, k), n = (int)e->width;
    for (int s = 0; s < e->n_state; s++) memset(&e->d[s][first], 0, TERMS * sizeof(double));
    for (int i = 0; i < TERMS; i++) memset(e->gram[first + i], 0, (size_t)n * sizeof(double));
    for (int i = 0; i < n; i++) memset(&e->gram[i][first], 0, TERMS * sizeof(double));
}

/* ring x ring begins anew at a closing; what it was so far stays with the blocks closed before */
static void begin_ring_ring(Tables *t)
{
    Engine *e = t->e;
    const int ring = (int)e->ring;
    for (int p = 0; p < e->n_recent; p++)
        for (int s = 0; s < e->n_state; s++)
            for (int r = 0; r < e->n_state; r++) t->closed[p].w_start[s][r] -= ring_ring(e, s, r);
    for (int s = 0; s < e->n_state; s++)
        for (int r = 0; r < e->n_state; r++) e->gram[ring + s][ring + r] = 0.0;
}

static void close_block(Tables *t, int k)
{
    Engine *e = t->e;
    const int ring = (int)e->ring, first = first_open(e, k), p = (int)e->open_recent[k];
    Closed *item = &t->closed[p];
    const double *d0 = e->d[0], *d1 = e->d[1];
    const double det = e->n_state == 2 ? d0[ring] * d1[ring + 1] - d0[ring + 1] * d1[ring] : 1.0;
    State left;
    begin_ring_ring(t);
    item->status = YOUNG;
    item->size = 0.0;
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
    for (int s = 0; s < e->n_state; s++) {
        memset(item->w_start[s], 0, sizeof item->w_start[s]);
        memcpy(item->shared_start[s], e->gram[ring + s], (size_t)(1 + e->n_shared) * sizeof(double));
    }
    read_through(e, k, 1.0, item->through);
    add_own(t, k);
    for (int other = 0; other < e->n_open; other++) {
        if (other == k) continue;
        add_open_pair(t, k, other);
        read_through(e, other, -1.0, left);
        add_tile(e, item, e->open_recent[other], item->d, left);
    }
    clear_open(e, k);
    e->young[e->n_young++] = p;
    e->n_closed++;
}

static void settle_young(Tables *t, int a)
{
    Engine *e = t->e;
    const int p = (int)e->young[a];
    Closed *item = &t->closed[p];
    State own, left;
    weigh(e, item, own, left);
    add_tile(e, item, p, own, item->d);
    spread(e, item, left, e->ringing, (int)(TERMS * e->n_recent));
    for (int b = 0; b < a; b++) add_tile(e, item, e->young[b], left, t->closed[e->young[b]].d);
}

static void settle_one(Tables *t, int k, int p)
{
    Engine *e = t->e;
    Closed *item = &t->closed[p];
    State own, left;
    int later = 0;
    if (item->status == YOUNG) {
        while (e->young[later] != p) later++;
        settle_young(t, later);
        e->n_young--;
        for (int a = later; a < e->n_young; a++) e->young[a] = e->young[a + 1];
    } else {
        weigh(e, item, own, left);
        spread(e, item, left, e->ringing, (int)(TERMS * e->n_recent));
    }
    for (int a = later; a < e->n_young; a++) {
        Closed *young = &t->closed[e->young[a]];
        weigh(e, young, own, left);
        add_tile(e, young, p, left, item->d);
    }
    for (int other = 0; other < e->n_open; other++) {
        if (other == k) continue;
        read_through(e, other, 1.0, left);
        add_tile(e, item, e->open_recent[other], item->d, left);
    }
    add_shared(t, item);
}

static void resume(Tables *t, int k, int p)
{
    Engine *e = t->e;
    Closed *item = &t->closed[p];
    const int ring = (int)e->ring, first = first_open(e, k);
    settle_one(t, k, p);
    for (int s = 0; s < e->n_state; s++)
        for (int i = 0; i < TERMS; i++) {
            e->ringing[s][TERMS * p + i] = 0.0;
            for (int r = 0; r < e->n_state; r++) e->d[s][first + i] += e->d[s][ring + r] * item->d[r][i];
        }
    item->status = OPEN;
    e->open_recent[k] = p;
    e->n_closed--;
}

static void open_block(Tables *t, int k, int edge, int64_t slot)
{
    Engine *e = t->e;
    if (k == e->n_open) {
        set_open(e, k + 1);
        clear_open(e, k);
    }
    e->open_edge[k] = edge;
    e->open_slot[k] = slot;
    e->place[edge] = k;
    for (int p = 0; p < e->n_recent; p++)
        if (t->closed[p].slot == slot && t->closed[p].status >= YOUNG) {
            resume(t, k, p);
            return;
        }
    e->open_recent[k] = admit(t, slot);
}

static void remove_open(Engine *e, int k)
{
    const int last = (int)e->n_open - 1, to = first_open(e, k), source = first_open(e, last);
    e->place[e->open_edge[k]] = -1;
    if (k < last) {
        for (int s = 0; s < e->n_state; s++)
            memmove(&e->d[s][to], &e->d[s][source], TERMS * sizeof(double));
        for (int i = 0; i < TERMS; i++) {
            memmove(e->gram[to + i], e->gram[source + i], (size_t)to * sizeof(double));
            for (int j = to + TERMS; j < source; j++) e->gram[j][to + i] = e->gram[source + i][j];
            memmove(&e->gram[to + i][to], &e->gram[source + i][source], TERMS * sizeof(double));
        }
        e->open_edge[k] = e->open_edge[last];
        e->open_slot[k] = e->open_slot[last];
        e->open_recent[k] = e->open_recent[last];
        e->place[e->open_edge[k]] = k;
    }
    clear_open(e, last);
    set_open(e, last);
}

/* ---- the ring begins anew ---- */

static double advance_one(Engine *e, Closed *item, int p)
{
    const int ring = (int)e->ring;
    double largest = 0.0;
    for (int s = 0; s < e->n_state; s++)
        for (int i = 0; i < TERMS; i++) {
            double value = 0.0;
            for (int r = 0; r < e->n_state; r++) value += e->d[s][ring + r] * item->d[r][i];
            e->ringing[s][TERMS * p + i] = value;
            largest = fmax(largest, fabs(value));
        }
    for (int s = 0; s < e->n_state; s++) memcpy(item->d[s], &e->ringing[s][TERMS * p], sizeof item->d[s]);
    memset(item->through, 0, sizeof item->through);
    memset(item->w_start, 0, sizeof item->w_start);
    memset(item->shared_start, 0, sizeof item->shared_start);
    return largest;
}

static void settle_ringing(Tables *t)
{
    Engine *e = t->e;
    const int n = (int)(TERMS * e->n_recent);
    int first = 0;
    while (first < e->n_recent && t->closed[first].status != RINGING) first++;
    if (first == e->n_recent) return;
    memset(e->weighted, 0, sizeof e->weighted);
    for (int s = 0; s < e->n_state; s++)
        for (int r = 0; r < e->n_state; r++) {
            const double w = ring_ring(e, s, r) - t->closed[first].w_start[s][r];
            for (int j = 0; j < n; j++) e->weighted[s][j] += w * e->ringing[r][j];
        }
    for (int p = 0; p < e->n_recent; p++) {
        Closed *item = &t->closed[p];
        if (item->status != RINGING) continue;
        spread(e, item, item->d, e->weighted, TERMS * (p + 1));
        add_shared(t, item);
    }
}

static void settle_open(Tables *t, int k)
{
    Engine *e = t->e;
    Closed *item = &t->closed[e->open_recent[k]];
    State left;
    add_own(t, k);
    for (int other = 0; other < k; other++) add_open_pair(t, k, other);
    read_through(e, k, 1.0, left);
    spread(e, item, left, e->ringing, (int)(TERMS * e->n_recent));
    for (int a = 0; a < e->n_young; a++) add_tile(e, item, e->young[a], left, t->closed[e->young[a]].d);
}

static void rebase(Tables *t)
{
    Engine *e = t->e;
    const int ring = (int)e->ring, n = (int)e->width;
    for (int k = 0; k < e->n_open; k++) settle_open(t, k);
    for (int i = 0; i < 1 + e->n_shared; i++)
        for (int j = 0; j < 1 + e->n_shared; j++) e->shared[i][j] += local(e, i, j);
    settle_ringing(t);
    for (int a = 0; a < e->n_young; a++) {
        settle_young(t, a);
        add_shared(t, &t->closed[e->young[a]]);
    }
    e->n_young = 0;
    for (int p = (int)e->n_recent - 1; p >= 0; p--) {
        Closed *item = &t->closed[p];
        if (item->status < YOUNG) continue;
        item->status = RINGING;
        if (!(advance_one(e, item, p) > e->ring_floor * item->size)) {
            e->n_closed--;
            release(t, p);
        }
    }
    for (int i = 0; i < n; i++) memset(e->gram[i], 0, (size_t)n * sizeof(double));
    for (int s = 0; s < e->n_state; s++)
        for (int r = 0; r < e->n_state; r++) e->d[s][ring + r] = s == r;
    e->ring_det = 1.0;
}

static void forget(Tables *t)
{
    Engine *e = t->e;
    const int ring = (int)e->ring, opened = first_open(e, 0);
    rebase(t);
    for (int p = (int)e->n_recent - 1; p >= 0; p--)
        if (t->closed[p].status == RINGING) release(t, p);
    e->n_closed = 0;
    for (int s = 0; s < e->n_state; s++) {
        memset(e->d[s], 0, (size_t)ring * sizeof(double));
        memset(&e->d[s][opened], 0, (size_t)((int)e->width - opened) * sizeof(double));
    }
}

static void stop(Tables *t)
{
    Engine *e = t->e;
    if (e->running) {
        forget(t);
        while (e->n_open > 0) {
            release(t, (int)e->open_recent[e->n_open - 1]);
            remove_open(e, (int)e->n_open - 1);
        }
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
    memset(e->echo, 0, sizeof e->echo);
    for (int a = 0; a < e->n_chambers; a++)
        for (int b = 0; b < e->n_chambers; b++) e->cov[a][b] = position_noise(e, a, b);
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

static void change(Tables *t, const Point *p, int i)
{
    Engine *e = t->e;
    const int was_open = e->place[i] >= 0;
    int k = (int)e->place[i];
    e->counters[BLOCK_CHANGES]++;
    e->cell[i][0] = p->u, e->cell[i][1] = p->dp;
    if (was_open) close_block(t, k);
    if (p->u != SHUT) {
        if (!was_open) k = (int)e->n_open;
        open_block(t, k, i, slot_of(t, i));
    } else if (was_open)
        remove_open(e, k);
}

static int moved(const Engine *e, const Point *p, int i)
{
    return p->u != e->cell[i][0] || (p->u != SHUT && p->dp != e->cell[i][1]);
}

/* edges that shut come first, or a reversal could exceed the places for open blocks */
static void change_blocks(Tables *t, const Point *points)
{
    Engine *e = t->e;
    int any = 0;
    for (int i = 0; i < e->n_edges; i++) any |= moved(e, &points[i], i);
    if (!any) return;
    if (e->n_open + e->n_closed + e->max_open > t->max_closed) {
        e->counters[RESTART_MEMORY]++;
        forget(t);
        start_whitener(e);
    }
    for (int opening = 0; opening < 2; opening++)
        for (int i = 0; i < e->n_edges; i++)
            if ((points[i].u != SHUT) == opening && moved(e, &points[i], i)) change(t, &points[i], i);
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
    const int i = (int)e->open_edge[k], first = first_open(e, k);
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

static double column_variance(const Engine *e, int c)
{
    const double w = (e->v0_m3[c] + e->area_m2[c] * e->values[e->x_column]) * e->compliance[c];
    return w * w * e->p_var_pa2[c];
}

static void row_one(Engine *e)
{
    const int n = (int)e->width;
    const double s = e->cov[0][0] + position_noise(e, 0, 0);
    const double scale = 1.0 / sqrt(s), keep = position_noise(e, 0, 0) / s, v = column_variance(e, 0);
    double *restrict d = e->d[0], row[MAX_LOCAL];
    for (int j = 0; j < n; j++) {
        row[j] = scale * d[j];
        d[j] *= keep;
    }
    e->noise_gram[0] += (v + e->echo[0][0]) / s;
    e->echo[0][0] = keep * keep * e->echo[0][0] + (1.0 - keep) * (1.0 - keep) * v;
    e->cov[0][0] *= keep;
    e->ring_det *= keep;
    for (int i = 0; i < n; i += LANES)
        for (int j = 0; j <= i; j += LANES)
            for (int q = i; q < i + LANES; q++)
                for (int l = j; l < j + LANES; l++) e->gram[q][l] += row[q] * row[l];
}

/* what the noise in column -V dP of chamber c adds on average, k = R S^-1 */
static void column_noise(Engine *e, int c, const double k[2][2], const double s[3], double det)
{
    double *m = e->echo[c];
    const double v = column_variance(e, c), a = (c == 0) - k[0][c], b = (c == 1) - k[1][c];
    const double m0 = m[0], m1 = m[1], m2 = m[2];
    const double x0 = m0 + (c == 0 ? v : 0.0), x2 = m2 + (c == 1 ? v : 0.0);
    e->noise_gram[c] += det * (s[2] * x0 - 2.0 * s[1] * m1 + s[0] * x2);
    m[0] = k[0][0] * k[0][0] * m0 + 2.0 * k[0][0] * k[0][1] * m1 + k[0][1] * k[0][1] * m2 + a * a * v;
    m[1] = k[0][0] * k[1][0] * m0 + (k[0][0] * k[1][1] + k[0][1] * k[1][0]) * m1 + k[0][1] * k[1][1] * m2
           + a * b * v;
    m[2] = k[1][0] * k[1][0] * m0 + 2.0 * k[1][0] * k[1][1] * m1 + k[1][1] * k[1][1] * m2 + b * b * v;
}

static void row_two(Engine *e)
{
    const int n = (int)e->width;
    const double r00 = position_noise(e, 0, 0), r01 = position_noise(e, 0, 1), r11 = position_noise(e, 1, 1);
    const double p00 = e->cov[0][0], p01 = e->cov[0][1], p11 = e->cov[1][1];
    const double s[3] = {p00 + r00, p01 + r01, p11 + r11};
    const double i0 = 1.0 / sqrt(s[0]), c = s[1] * i0, i1 = 1.0 / sqrt(s[2] - c * c), ci0 = c * i0;
    const double det = 1.0 / (s[0] * s[2] - s[1] * s[1]);
    const double k[2][2] = {{(r00 * s[2] - r01 * s[1]) * det, (r01 * s[0] - r00 * s[1]) * det},
                            {(r01 * s[2] - r11 * s[1]) * det, (r11 * s[0] - r01 * s[1]) * det}};
    double *restrict d0 = e->d[0], *restrict d1 = e->d[1], row0[MAX_LOCAL], row1[MAX_LOCAL];
    for (int j = 0; j < n; j++) {
        const double x = d0[j], y = d1[j];
        row0[j] = i0 * x;
        row1[j] = i1 * (y - ci0 * x);
        d0[j] = k[0][0] * x + k[0][1] * y;
        d1[j] = k[1][0] * x + k[1][1] * y;
    }
    for (int chamber = 0; chamber < 2; chamber++) column_noise(e, chamber, k, s, det);
    e->cov[0][0] = k[0][0] * p00 + k[0][1] * p01;
    e->cov[1][1] = k[1][0] * p01 + k[1][1] * p11;
    e->cov[0][1] = e->cov[1][0] =
        0.5 * (k[0][0] * p01 + k[0][1] * p11 + k[1][0] * p00 + k[1][1] * p01);
    e->ring_det *= k[0][0] * k[1][1] - k[0][1] * k[1][0];
    for (int i = 0; i < n; i += LANES)
        for (int j = 0; j <= i; j += LANES)
            for (int q = i; q < i + LANES; q++)
                for (int l = j; l < j + LANES; l++) e->gram[q][l] += row0[q] * row0[l] + row1[q] * row1[l];
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
        e->rows += 1.0;
        if (e->n_chambers == 2) row_two(e); else row_one(e);
    }
    if (e->ring_det < RING_DET_LIMIT) rebase(t);
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
    const double dt = floor((sample[0] - e->t_s) * 1e6 + 0.5) * 1e-6, *now = sample + 2;
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
        const int64_t recent = e->n_open + e->n_closed + e->max_open;
        if (e->n_slots + e->max_open > max_blocks ||
            10 * (e->n_pairs + recent * recent / 2) > 6 * max_pairs)
            return k;
        take(&t, chunk + k * (2 + e->n_signals));
    }
    return n;
}
