/* Sparse information sums of rows that touch many blocks, each with a fading memory: see
 * rtid/kernels/sparse_sums.py for the algebra.  Here the state of a column is one number, and what
 * two blocks share goes straight to the dense triangle of sums.
 *
 * A block that was left rings as d x ring, with one ring for all.  So with a later visit v, whose
 * column is c_v, it shares d' sum(ring c_v), and both factors can wait: the product is made when one
 * of the two changes, or when the earlier one is silent.  Closed visits stand in a line, in the order
 * in which they closed; each owes a tile to all before it that ring, and to none behind it.  The
 * oldest is settled with those behind it, a few tiles per tick, then leaves the line. */
#include "rtid_estimator_sums.h"

#include <string.h>

/* ---- sums that go on for ever ---- */

static rtid_sum *sum_at(rtid_estimator *e, int i, int j)
{
    const uint32_t row = (uint32_t)i;
    return &e->sums[((row * (row + 1u)) / 2u) + (uint32_t)j];
}

static int at_slot(int slot) { return RTID_EST_BLOCKS_AT + (T * slot); }

/* Term i of a block with column j of the sums: y, shared or its own, += x.  Its condition number
 * multiplies the error of these sums: what one addition rounds off, the next one adds. */
static void add_kept(rtid_estimator *e, int slot, int i, int j, rtid_sum x)
{
    rtid_sum *sum = sum_at(e, at_slot(slot) + i, j);
#ifdef RTID_ESTIMATOR_FLOAT32
    merge(sum, x); /* of two floats */
#else
    const int column = (j < RTID_EST_BLOCKS_AT) ? j : (j - (T * slot));
    double *lost = &e->lost[slot][(i * RTID_EST_BLOCKS_AT) + ((i * (i + 1)) / 2) + column];
    const double before = *sum, added = x + *lost, back = (before + added) - before;
    *sum = before + added;
    *lost = (before - (*sum - back)) + (added - back);
#endif
}

/* Lower triangle of what a block shares with itself += left' right + right' left, or half of that. */
static void add_own_tile(rtid_estimator *e, int slot, const rtid_sum *left, const rtid_real *right,
                         bool both)
{
    for (int i = 0; i < T; i++) {
        for (int j = 0; j <= i; j++) {
            rtid_sum x = times(left[i], right[j]);
            if (both) {
                merge(&x, times(left[j], right[i]));
            }
            add_kept(e, slot, i, at_slot(slot) + j, x);
        }
    }
}

/* What two blocks share += left' right. */
static void add_tile(rtid_estimator *e, int slot, int other, const rtid_sum *left,
                     const rtid_real *right)
{
    const int mine = at_slot(slot), its = at_slot(other);
    if (slot == other) {
        add_own_tile(e, slot, left, right, true);
    }
    for (int i = 0; (i < T) && (mine > its); i++) {
        rtid_sum *target = sum_at(e, mine + i, its);
        for (int j = 0; j < T; j++) {
            merge(&target[j], times(left[i], right[j]));
        }
    }
    for (int j = 0; (j < T) && (mine < its); j++) {
        rtid_sum *target = sum_at(e, its + j, mine);
        for (int i = 0; i < T; i++) {
            merge(&target[i], times(left[i], right[j]));
        }
    }
}

/* ---- local columns: those that move at every sample, and their products ---- */

void rtid_est_set_open(rtid_estimator *e, int n)
{
    e->owed.n_open = (int16_t)n;
    e->width = (int16_t)first_of(n);
}

static void clear_columns(rtid_estimator *e, int first, int last)
{
    for (int i = first; i < e->width; i++) {
        for (int j = (i < last) ? 0 : first; (j <= i) && ((i < last) || (j < last)); j++) {
            e->owed.local[i][j] = as_sum(0);
        }
    }
}

/* Of open block k with itself, y and the shared columns. */
static void add_own(rtid_estimator *e, int k)
{
    const int first = first_of(k), slot = e->owed.open[k].slot;
    for (int i = 0; i < T; i++) {
        for (int j = 0; j < RTID_EST_BLOCKS_AT; j++) {
            add_kept(e, slot, i, j, e->owed.local[first + i][j]);
        }
        for (int j = 0; j <= i; j++) {
            add_kept(e, slot, i, at_slot(slot) + j, e->owed.local[first + i][first + j]);
        }
    }
}

/* Of open block k with another open one. */
static void add_open_pair(rtid_estimator *e, int k, int other)
{
#if RTID_EST_MAX_OPEN > 1
    const int a = (k > other) ? k : other, b = (k > other) ? other : k;
    const int slot_a = at_slot(e->owed.open[a].slot), slot_b = at_slot(e->owed.open[b].slot);
    for (int i = 0; i < T; i++) {
        for (int j = 0; j < T; j++) {
            const rtid_sum product = e->owed.local[first_of(a) + i][first_of(b) + j];
            if (slot_a > slot_b) {
                merge(sum_at(e, slot_a + i, slot_b + j), product);
            } else {
                merge(sum_at(e, slot_b + j, slot_a + i), product);
            }
        }
    }
#else
    (void)e, (void)k, (void)other; /* there is none, and compilers cannot see it */
#endif
}

/* ---- visits ---- */

/* So many tiles' work is done in this tick. */
static void spend(rtid_estimator *e, int tiles)
{
    e->tiles = (int16_t)((e->tiles > tiles) ? (e->tiles - tiles) : 0);
}

static rtid_real power(int n) { return LDEXP(R(1), n); } /* 0 where that is too small */

/* Epochs from one to another, whose counter may have gone round. */
static int apart_of(uint32_t later, uint32_t earlier)
{
    const uint32_t apart = later - earlier;
    return (int32_t)apart;
}

bool rtid_est_rings(const rtid_estimator_visit *v)
{
    return (v->status >= RINGING) && (v->status <= SILENT_NOW);
}

rtid_real rtid_est_units(const rtid_estimator_visit *later, const rtid_estimator_visit *earlier)
{
    return power(-apart_of(later->epoch, earlier->epoch));
}

rtid_sum rtid_est_ring(const rtid_estimator_owed *o, const rtid_estimator_visit *v)
{
    if (v->memory != o->memory) {
        return v->ring;
    }
    return sum_of(v->ring, scaled(o->local[RTID_EST_RING][RTID_EST_RING], v->fade * v->fade));
}

rtid_sum rtid_est_shared(const rtid_estimator_owed *o, const rtid_estimator_visit *v, int j)
{
    if (v->memory != o->memory) {
        return v->shared[j];
    }
    return sum_of(v->shared[j], scaled(o->local[RTID_EST_RING][j], v->fade));
}

void rtid_est_left(const rtid_estimator_owed *o, const rtid_estimator_visit *v, rtid_sum *left)
{
    const rtid_sum ring = rtid_est_rings(v) ? rtid_est_ring(o, v) : as_sum(0);
    for (int i = 0; i < T; i++) {
        left[i] = rtid_est_rings(v) ? sum_of(v->left[i], times(ring, v->d[i])) : v->left[i];
    }
}

void rtid_est_take_left(rtid_estimator_owed *o, int k)
{
    rtid_estimator_visit *v = &o->visit[o->open[k].visit];
    for (int i = 0; i < T; i++) {
        rtid_sum *through = &o->local[first_of(k) + i][RTID_EST_RING];
        merge(&v->left[i], scaled(*through, v->fade));
        *through = as_sum(0);
    }
}

static rtid_estimator_visit *open_visit(rtid_estimator *e, int k)
{
    return &e->owed.visit[e->owed.open[k].visit];
}

static rtid_estimator_visit *at_line(rtid_estimator *e, int n)
{
    return &e->owed.visit[e->owed.line[n]];
}

/* From now on nothing is known of what a visit shares with the ring. */
static void begin_visit(const rtid_estimator *e, rtid_estimator_visit *v)
{
    v->memory = e->owed.memory;
    v->epoch = e->owed.epoch;
    v->fade = R(1);
    for (int i = 0; i < T; i++) {
        v->left[i] = as_sum(0);
    }
}

/* A visit that begins now; rtid_est_is_full has said that there is room. */
static int admit(rtid_estimator *e, int slot)
{
    int p = e->owed.last_begun;
    do {
        p = ((p + 1) < RTID_EST_MAX_VISITS) ? (p + 1) : 0;
    } while (e->owed.visit[p].status != FREE);
    e->owed.last_begun = (int16_t)p;
    e->owed.visit[p].slot = (int16_t)slot;
    e->owed.visit[p].status = OPEN;
    begin_visit(e, &e->owed.visit[p]);
    return p;
}

bool rtid_est_is_full(const rtid_estimator *e)
{
    /* each edge that changes its block closes one visit, splits those of the others, opens one */
    const int most = RTID_EST_MAX_OPEN, least = most * (most + 3);
    return (e->owed.n_line + e->owed.n_open + least) > RTID_EST_MAX_VISITS;
}

/* Take `many` visits out of the line, from the n-th on. */
static void leave_line(rtid_estimator *e, int n, int many)
{
    rtid_estimator_owed *o = &e->owed;
    for (int a = n; a < (n + many); a++) {
        at_line(e, a)->status = FREE;
    }
    o->n_line = (int16_t)(o->n_line - many);
    for (int a = n; a < o->n_line; a++) {
        o->line[a] = o->line[a + many];
    }
    if (n == 0) {
        o->n_paid = 0;
    } else if (n <= o->n_paid) {
        o->n_paid--;
    } else {
        /* behind those that are paid */
    }
}

/* What ended owes to the same visits as the next one of its block, if none that rings stands
 * between: the n-th takes over from such a one. */
static void take_over(rtid_estimator *e, int n)
{
    rtid_estimator_visit *v = at_line(e, n);
    for (int a = n - 1; a > 0 && a >= n - MOST_SCANNED; a--) {
        const rtid_estimator_visit *before = at_line(e, a);
        const int apart = apart_of(v->epoch, before->epoch);
        if (before->memory != v->memory || rtid_est_rings(before)) {
            return;
        }
        if (before->slot != v->slot || (a <= e->owed.n_paid) != (n <= e->owed.n_paid)
            || apart > MOST_APART) {
            continue;
        }
        for (int i = 0; i < T; i++) {
            merge(&v->left[i], scaled(before->left[i], power(apart)));
        }
        leave_line(e, a, 1);
        return;
    }
}

/* The same for the n-th visit, which has just ended, and those behind it up to one that rings. */
static void take_over_from(rtid_estimator *e, int n)
{
    int at = n;
    for (int k = 0; (k < MOST_SCANNED) && (at < e->owed.n_line); k++) {
        const int before = e->owed.n_line;
        const bool last = (k > 0) && rtid_est_rings(at_line(e, at));
        take_over(e, at);
        at += (e->owed.n_line == before) ? 1 : 0;
        if (last) {
            return;
        }
    }
}

static void join_line(rtid_estimator *e, int p)
{
    e->owed.line[e->owed.n_line] = (int16_t)p;
    e->owed.n_line++;
    take_over(e, e->owed.n_line - 1);
}

/* The last visit in the line that rings is of this memory. */
static bool any_rings(rtid_estimator *e)
{
    int a = e->owed.n_line - 1;
    while ((a >= 0) && (at_line(e, a)->memory == e->owed.memory)
           && !rtid_est_rings(at_line(e, a))) {
        a--;
    }
    return (a >= 0) && (at_line(e, a)->memory == e->owed.memory);
}

/* What open block k shares with the ring up to now goes into the line as a visit that ended. */
static void split(rtid_estimator *e, int k)
{
    rtid_estimator_visit *v = open_visit(e, k);
    rtid_est_take_left(&e->owed, k);
    if (any_rings(e)) {
        const int p = admit(e, v->slot);
        e->owed.visit[p] = *v;
        e->owed.visit[p].status = ENDED;
        join_line(e, p);
    }
    begin_visit(e, v);
}

/* ---- what two visits share ---- */

/* Of a later visit with an earlier one that rings, up to now. */
static void share(rtid_estimator *e, const rtid_estimator_visit *later,
                  const rtid_estimator_visit *earlier)
{
    const rtid_real units = rtid_est_units(later, earlier);
    rtid_sum left[T];
    rtid_real d[T];
    rtid_est_left(&e->owed, later, left);
    for (int i = 0; i < T; i++) {
        d[i] = units * earlier->d[i];
    }
    add_tile(e, later->slot, earlier->slot, left, d);
    spend(e, 1);
}

static void share_open(rtid_estimator *e, int k, const rtid_estimator_visit *earlier)
{
    rtid_est_take_left(&e->owed, k);
    share(e, open_visit(e, k), earlier);
}

/* Of a visit with itself, y and the shared columns since it closed. */
static void settle_own(rtid_estimator *e, const rtid_estimator_visit *v)
{
    const rtid_sum ring = rtid_est_ring(&e->owed, v);
    rtid_sum own[T];
    for (int i = 0; i < T; i++) {
        own[i] = times(ring, v->d[i]);
    }
    add_own_tile(e, v->slot, own, v->d, false);
    for (int j = 0; j < RTID_EST_BLOCKS_AT; j++) {
        const rtid_sum since = rtid_est_shared(&e->owed, v, j);
        for (int i = 0; i < T; i++) {
            add_kept(e, v->slot, i, j, times(since, v->d[i]));
        }
    }
    spend(e, 1);
}

/* ---- open and closed ---- */

void rtid_est_close(rtid_estimator *e, int k)
{
    rtid_estimator_owed *o = &e->owed;
    rtid_estimator_visit *v = open_visit(e, k);
    for (int other = 0; other < o->n_open; other++) {
        if (other != k) {
            split(e, other);
            add_open_pair(e, k, other);
        }
    }
    add_own(e, k);
    if (!any_rings(e) || (apart_of(o->epoch, v->epoch) > MOST_APART)) {
        split(e, k);
    }
    rtid_est_take_left(o, k);
    for (int i = 0; i < T; i++) {
        v->left[i] = scaled(v->left[i], R(1) / v->fade);
        v->d[i] = e->d[first_of(k) + i] / e->d[RTID_EST_RING];
        e->d[first_of(k) + i] = 0;
    }
    v->epoch = o->epoch;
    v->fade = R(1);
    v->start = e->d[RTID_EST_RING];
    v->ring = minus(o->local[RTID_EST_RING][RTID_EST_RING]);
    for (int j = 0; j < RTID_EST_BLOCKS_AT; j++) {
        v->shared[j] = minus(o->local[RTID_EST_RING][j]);
    }
    v->status = RINGING;
    clear_columns(e, first_of(k), first_of(k + 1));
    e->n_closed++;
    join_line(e, o->open[k].visit);
    spend(e, 2);
}

/* Let the n-th visit of the line go on as open block k: all behind it is settled with it. */
static void go_on(rtid_estimator *e, int k, int n)
{
    rtid_estimator_owed *o = &e->owed;
    rtid_estimator_visit *v = at_line(e, n);
    rtid_sum left[T];
    for (int a = n + 1; a < o->n_line; a++) {
        share(e, at_line(e, a), v);
    }
    for (int other = 0; other < o->n_open; other++) {
        if (other != k) {
            share_open(e, other, v);
        }
    }
    settle_own(e, v);
    rtid_est_left(o, v, left);
    (void)memcpy(v->left, left, sizeof left);
    for (int i = 0; i < T; i++) {
        e->d[first_of(k) + i] = e->d[RTID_EST_RING] * v->fade * v->d[i];
    }
    v->status = ENDED;
    take_over_from(e, n);
}

/* A block's visit of this memory, not yet taken up again. */
static bool is_of(const rtid_estimator_visit *v, int slot, uint16_t memory)
{
    return (v->slot == slot) && (v->status == RINGING) && (v->memory == memory);
}

void rtid_est_open(rtid_estimator *e, int k, int edge, int slot)
{
    rtid_estimator_owed *o = &e->owed;
    int n = o->n_line - 1;
    if (k == o->n_open) {
        rtid_est_set_open(e, k + 1);
    }
    o->open[k].edge = (int16_t)edge;
    o->open[k].slot = (int16_t)slot;
    o->open[k].u = e->edge[edge].u;
    o->open[k].dp = e->edge[edge].dp;
    e->edge[edge].place = (int16_t)k;
    while ((n >= 0) && !is_of(at_line(e, n), slot, o->memory)) {
        n--;
    }
    if (n >= 0) {
        e->n_closed--;
        if (((o->n_line - n) + o->n_open) <= e->tiles) {
            go_on(e, k, n);
        } else {
            at_line(e, n)->status = ECHO; /* too much for one tick: it rings on by itself */
        }
    }
    o->open[k].visit = (int16_t)admit(e, slot);
}

void rtid_est_remove_open(rtid_estimator *e, int k)
{
    rtid_estimator_owed *o = &e->owed;
    const int last = o->n_open - 1, to = first_of(k), source = first_of(last);
    e->edge[o->open[k].edge].place = -1;
    if (k < last) {
        for (int i = 0; i < T; i++) {
            e->d[to + i] = e->d[source + i];
            e->d[source + i] = 0;
            for (int j = 0; j < to; j++) {
                o->local[to + i][j] = o->local[source + i][j];
            }
            for (int j = to + T; j < source; j++) {
                o->local[j][to + i] = o->local[source + i][j];
            }
            for (int j = 0; j <= i; j++) {
                o->local[to + i][to + j] = o->local[source + i][source + j];
            }
        }
        o->open[k] = o->open[last];
        e->edge[o->open[k].edge].place = (int16_t)k;
    }
    clear_columns(e, source, source + T);
    rtid_est_set_open(e, last);
}

/* ---- epochs and memories ---- */

/* The oldest visit is settled with all behind it; it leaves the line. */
static void leave_first(rtid_estimator *e)
{
    settle_own(e, at_line(e, 0));
    leave_line(e, 0, 1);
    if (!any_rings(e)) {
        for (int k = 0; k < e->owed.n_open; k++) {
            rtid_est_take_left(&e->owed, k);
            begin_visit(e, open_visit(e, k)); /* it owes nothing to anybody */
        }
    }
}

/* Visits at the head of the line that went on as others. */
static int count_ended(rtid_estimator *e)
{
    int n = 0;
    while ((n < e->owed.n_line) && (at_line(e, n)->status == ENDED)) {
        n++;
    }
    return n;
}

void rtid_est_pay(rtid_estimator *e)
{
    rtid_estimator_owed *o = &e->owed;
    if (e->tiles > MOST_PAID) {
        e->tiles = MOST_PAID;
    } else if (e->tiles < LEAST_PAID) {
        e->tiles = LEAST_PAID;
    } else {
        /* what the sample has left */
    }
    while ((o->n_line > 0) && (e->tiles > 0)) {
        const rtid_estimator_visit *first = at_line(e, 0);
        const int next = o->n_paid + 1;
        const bool now = first->memory == o->memory;
        if (first->status == ENDED) { /* it owes nothing */
            leave_line(e, 0, count_ended(e));
            continue;
        }
        if (now && (first->status != SILENT_NOW)) {
            return;
        }
        if ((next < o->n_line) && (at_line(e, next)->memory == first->memory)) {
            share(e, at_line(e, next), first);
            o->n_paid++;
            continue;
        }
        for (int k = 0; now && (k < o->n_open); k++) {
            share_open(e, k, first);
        }
        leave_first(e);
    }
}

/* Products of the rows of this epoch go to the sums and to the visits that ring. */
static void close_epoch(rtid_estimator *e)
{
    rtid_estimator_owed *o = &e->owed;
    for (int a = 0; a < o->n_line; a++) {
        rtid_estimator_visit *v = at_line(e, a);
        if ((v->memory != o->memory) || !rtid_est_rings(v)) {
            continue;
        }
        merge(&v->ring, scaled(o->local[RTID_EST_RING][RTID_EST_RING], v->fade * v->fade));
        for (int j = 0; j < RTID_EST_BLOCKS_AT; j++) {
            merge(&v->shared[j], scaled(o->local[RTID_EST_RING][j], v->fade));
        }
    }
    for (int k = 0; k < o->n_open; k++) {
        rtid_est_take_left(o, k);
        add_own(e, k);
        for (int other = 0; other < k; other++) {
            add_open_pair(e, k, other);
        }
    }
    for (int i = 0; i < RTID_EST_BLOCKS_AT; i++) {
        for (int j = 0; j <= i; j++) {
            merge(sum_at(e, i, j), o->local[i][j]);
        }
    }
    clear_columns(e, 0, e->width);
    spend(e, 1 + (o->n_line / 8));
}

void rtid_est_renew(rtid_estimator *e)
{
    rtid_estimator_owed *o = &e->owed;
    rtid_real shrink;
    int exponent;
    (void)FREXP(e->d[RTID_EST_RING], &exponent);
    shrink = power(exponent);
    close_epoch(e);
    o->epoch += (uint32_t)-exponent;
    for (int a = 0; a < o->n_line; a++) {
        at_line(e, a)->fade *= shrink;
    }
    for (int k = 0; k < o->n_open; k++) {
        open_visit(e, k)->fade *= shrink;
    }
    e->d[RTID_EST_RING] /= shrink;
    e->faded *= shrink;
}

void rtid_est_forget(rtid_estimator *e)
{
    const rtid_real ring = e->d[RTID_EST_RING];
    for (int a = 0; a < e->owed.n_line; a++) {
        rtid_estimator_visit *v = at_line(e, a);
        if ((v->memory != e->owed.memory) || ((v->status != RINGING) && (v->status != ECHO))
            || ((ring * v->fade) > (SILENT * v->start))) {
            continue;
        }
        if (v->status == RINGING) {
            e->n_closed--;
        }
        v->status = SILENT_NOW;
    }
    e->faded = R(1) / ring;
}

void rtid_est_end(rtid_estimator *e)
{
    rtid_estimator_owed *o = &e->owed;
    close_epoch(e);
    for (int k = 0; k < o->n_open; k++) {
        split(e, k);
    }
    o->memory++;
    for (int k = 0; k < o->n_open; k++) {
        begin_visit(e, open_visit(e, k));
    }
    e->n_closed = 0;
    for (int j = 0; j < RTID_EST_WIDTH; j++) {
        e->d[j] = 0;
    }
    e->d[RTID_EST_RING] = R(1);
    e->faded = R(1);
}

void rtid_est_stop(rtid_estimator *e)
{
    rtid_est_end(e);
    while (e->owed.n_open > 0) {
        open_visit(e, e->owed.n_open - 1)->status = FREE;
        rtid_est_remove_open(e, e->owed.n_open - 1);
    }
}
