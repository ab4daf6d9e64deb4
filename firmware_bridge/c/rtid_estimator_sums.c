/* Sparse information sums of rows that touch many blocks, each with a fading memory: see
 * rtid/kernels/sparse_sums.py for the algebra.  Here the state of a column is one number, and what
 * two blocks share goes straight to the dense triangle of sums. */
#include "rtid_estimator_sums.h"

#include <string.h>

/* ---- sums that go on for ever ---- */

static rtid_sum *sum_at(rtid_estimator *e, int i, int j)
{
    return &e->sums[(uint32_t)i * (uint32_t)(i + 1) / 2 + (uint32_t)j];
}

static int at_slot(int slot) { return RTID_EST_BLOCKS_AT + T * slot; }

/* Term i of a block with column j of the sums: y, shared or its own, += x.  Its condition number
 * multiplies the error of these sums: what one addition rounds off, the next one adds. */
static void add_kept(rtid_estimator *e, int slot, int i, int j, rtid_sum x)
{
    rtid_sum *sum = sum_at(e, at_slot(slot) + i, j);
#ifdef RTID_ESTIMATOR_FLOAT32
    merge(sum, x); /* of two floats */
#else
    const int column = j < RTID_EST_BLOCKS_AT ? j : j - T * slot;
    double *lost = &e->lost[slot][i * RTID_EST_BLOCKS_AT + i * (i + 1) / 2 + column];
    const double before = *sum, added = x + *lost, back = (before + added) - before;
    *sum = before + added;
    *lost = (before - (*sum - back)) + (added - back);
#endif
}

/* What a block shares with itself += left' right, which is symmetric: its lower triangle. */
static void add_own_tile(rtid_estimator *e, int slot, const rtid_sum *left, const rtid_real *right)
{
    for (int i = 0; i < T; i++)
        for (int j = 0; j <= i; j++)
            add_kept(e, slot, i, at_slot(slot) + j, times(left[i], right[j]));
}

/* What two blocks share += left' right. */
static void add_tile(rtid_estimator *e, int slot, int other, const rtid_sum *restrict left,
                     const rtid_real *restrict right)
{
    const int mine = at_slot(slot), its = at_slot(other);
    if (slot == other)
        add_own_tile(e, slot, left, right);
    for (int i = 0; i < T && mine > its; i++) {
        rtid_sum *restrict target = sum_at(e, mine + i, its);
        for (int j = 0; j < T; j++)
            merge(&target[j], times(left[i], right[j]));
    }
    for (int j = 0; j < T && mine < its; j++) {
        rtid_sum *restrict target = sum_at(e, its + j, mine);
        for (int i = 0; i < T; i++)
            merge(&target[i], times(left[i], right[j]));
    }
}

/* ---- local columns: those that move at every sample, and their products ---- */

void rtid_est_set_open(rtid_estimator *e, int n)
{
    e->n_open = (uint16_t)n;
    e->width = (uint16_t)first_of(n);
}

static void clear_columns(rtid_estimator *e, int first, int last)
{
    for (int i = 0; i < RTID_EST_WIDTH; i++)
        for (int j = 0; j <= i; j++)
            if ((i >= first && i < last) || (j >= first && j < last))
                e->local[i][j] = as_sum(0);
}

static rtid_sum ring_ring(const rtid_estimator *e)
{
    return e->local[RTID_EST_RING][RTID_EST_RING];
}

/* Ring x open block k. */
static void read_through(const rtid_estimator *e, int k, rtid_sum *out)
{
    for (int i = 0; i < T; i++)
        out[i] = e->local[first_of(k) + i][RTID_EST_RING];
}

/* ---- products of one block, see rtid/kernels/sparse_sums.py ---- */

/* Of open block k with itself, y and the shared columns. */
static void add_own(rtid_estimator *e, int k)
{
    const int first = first_of(k), slot = e->open[k].slot;
    for (int i = 0; i < T; i++) {
        for (int j = 0; j < 1 + RTID_EST_SHARED; j++)
            add_kept(e, slot, i, j, e->local[first + i][j]);
        for (int j = 0; j <= i; j++)
            add_kept(e, slot, i, at_slot(slot) + j, e->local[first + i][first + j]);
    }
}

/* Of open block k with another open one. */
static void add_open_pair(rtid_estimator *e, int k, int other)
{
#if RTID_EST_MAX_OPEN > 1
    const int a = k > other ? k : other, b = k + other - a;
    const int slot_a = at_slot(e->open[a].slot), slot_b = at_slot(e->open[b].slot);
    for (int i = 0; i < T; i++)
        for (int j = 0; j < T; j++) {
            const rtid_sum product = e->local[first_of(a) + i][first_of(b) + j];
            if (slot_a > slot_b)
                merge(sum_at(e, slot_a + i, slot_b + j), product);
            else
                merge(sum_at(e, slot_b + j, slot_a + i), product);
        }
#else
    (void)e, (void)k, (void)other; /* there is none, and compilers cannot see it */
#endif
}

/* left = what the closed block shares with the ring's origin, own = the part since it closed. */
static void weigh(const rtid_estimator *e, const rtid_estimator_recent *item, rtid_sum *own,
                  rtid_sum *left)
{
    const rtid_sum w = sum_of(ring_ring(e), minus(item->w_start));
    for (int i = 0; i < T; i++) {
        own[i] = times(w, item->d[i]);
        left[i] = sum_of(item->through[i], own[i]);
    }
}

/* Of a closed block with y and the shared columns since it closed. */
static void add_shared(rtid_estimator *e, const rtid_estimator_recent *item)
{
    for (int j = 0; j < 1 + RTID_EST_SHARED; j++) {
        const rtid_sum since = sum_of(e->local[RTID_EST_RING][j], minus(item->shared_start[j]));
        for (int i = 0; i < T; i++)
            add_kept(e, item->slot, i, j, times(since, item->d[i]));
    }
}

/* left x all blocks that rang all the time */
static void spread(rtid_estimator *e, int slot, const rtid_sum *left)
{
    for (int q = 0; q < e->n_recent; q++)
        if (e->recent[q].status == RINGING)
            add_tile(e, slot, e->recent[q].slot, left, e->recent[q].d);
}

/* ---- recent blocks ---- */

static int admit(rtid_estimator *e, int slot)
{
    int p = 0;
    while (p < e->n_recent && e->recent[p].status != FREE)
        p++;
    if (p == e->n_recent)
        e->n_recent++;
    e->recent[p].status = OPEN;
    e->recent[p].slot = (int16_t)slot;
    return p;
}

static void release(rtid_estimator *e, int p)
{
    e->recent[p].status = FREE;
    while (e->n_recent > 0 && e->recent[e->n_recent - 1].status == FREE)
        e->n_recent--;
}

/* Products of the a-th young block with itself and all that closed before it. */
static void settle_young(rtid_estimator *e, int a)
{
    const rtid_estimator_recent *item = &e->recent[e->young[a]];
    rtid_sum own[T], left[T];
    weigh(e, item, own, left);
    add_tile(e, item->slot, item->slot, own, item->d);
    spread(e, item->slot, left);
    for (int b = 0; b < a; b++)
        add_tile(e, item->slot, e->recent[e->young[b]].slot, left, e->recent[e->young[b]].d);
}

void rtid_est_close(rtid_estimator *e, int k)
{
    rtid_estimator_recent *item = &e->recent[e->open[k].recent];
    rtid_sum left[T];
    item->status = YOUNG;
    item->size = 0;
    for (int i = 0; i < T; i++) {
        const rtid_real d = e->d[first_of(k) + i];
        item->size = ABS(d) > item->size ? ABS(d) : item->size;
        item->d[i] = d / e->d[RTID_EST_RING];
        e->d[first_of(k) + i] = 0;
    }
    item->w_start = ring_ring(e);
    memcpy(item->shared_start, e->local[RTID_EST_RING], sizeof item->shared_start);
    read_through(e, k, item->through);
    add_own(e, k);
    for (int other = 0; other < e->n_open; other++)
        if (other != k) {
            add_open_pair(e, k, other);
            read_through(e, other, left);
            for (int i = 0; i < T; i++)
                left[i] = minus(left[i]); /* `other` will charge it from the beginning */
            add_tile(e, e->open[other].slot, item->slot, left, item->d);
        }
    clear_columns(e, first_of(k), first_of(k + 1));
    e->young[e->n_young++] = (uint16_t)e->open[k].recent;
    e->n_closed++;
}

/* Settle what closed block p shares with all but open block k; a young one is so no more. */
static void settle_one(rtid_estimator *e, int k, int p)
{
    const rtid_estimator_recent *item = &e->recent[p];
    rtid_sum own[T], left[T];
    int later = 0;
    if (item->status == YOUNG) {
        while (e->young[later] != p)
            later++;
        settle_young(e, later);
        e->n_young--;
        for (int a = later; a < e->n_young; a++)
            e->young[a] = e->young[a + 1];
    } else {
        weigh(e, item, own, left);
        spread(e, item->slot, left);
    }
    for (int a = later; a < e->n_young; a++) {
        const rtid_estimator_recent *young = &e->recent[e->young[a]];
        weigh(e, young, own, left);
        add_tile(e, young->slot, item->slot, left, item->d);
    }
    for (int other = 0; other < e->n_open; other++)
        if (other != k) {
            read_through(e, other, left);
            add_tile(e, e->open[other].slot, item->slot, left, item->d);
        }
    add_shared(e, item);
}

void rtid_est_open(rtid_estimator *e, int k, int edge, int slot)
{
    if (k == e->n_open)
        rtid_est_set_open(e, k + 1);
    e->open[k].edge = (int16_t)edge;
    e->open[k].slot = (int16_t)slot;
    e->open[k].u = e->edge[edge].u;
    e->open[k].dp = e->edge[edge].dp;
    e->edge[edge].place = (int16_t)k;
    for (int p = 0; p < e->n_recent; p++) {
        rtid_estimator_recent *item = &e->recent[p];
        if (item->slot != slot || item->status < YOUNG)
            continue;
        settle_one(e, k, p);
        for (int i = 0; i < T; i++)
            e->d[first_of(k) + i] = e->d[RTID_EST_RING] * item->d[i];
        item->status = OPEN;
        e->open[k].recent = (int16_t)p;
        e->n_closed--;
        return;
    }
    e->open[k].recent = (int16_t)admit(e, slot);
}

void rtid_est_remove_open(rtid_estimator *e, int k)
{
    const int last = e->n_open - 1, to = first_of(k), source = first_of(last);
    e->edge[e->open[k].edge].place = -1;
    if (k < last) {
        for (int i = 0; i < T; i++) {
            e->d[to + i] = e->d[source + i];
            e->d[source + i] = 0;
            for (int j = 0; j < to; j++)
                e->local[to + i][j] = e->local[source + i][j];
            for (int j = to + T; j < source; j++)
                e->local[j][to + i] = e->local[source + i][j];
            for (int j = 0; j <= i; j++)
                e->local[to + i][to + j] = e->local[source + i][source + j];
        }
        e->open[k] = e->open[last];
        e->edge[e->open[k].edge].place = (int16_t)k;
    }
    clear_columns(e, source, source + T);
    rtid_est_set_open(e, last);
}

/* ---- the ring begins anew ---- */

/* Note what a block shares with the first `partners` of those noted: too much work for one tick. */
static void owe(rtid_estimator *e, int slot, const rtid_sum *left, const rtid_real *d, int partners)
{
    rtid_estimator_debt *debt = &e->debt;
    debt->slot[debt->n] = (int16_t)slot;
    debt->partners[debt->n] = (uint16_t)partners;
    for (int i = 0; i < T; i++) {
        debt->left[debt->n][i] = left[i];
        debt->d[debt->n][i] = d[i];
    }
    debt->n++;
}

void rtid_est_pay(rtid_estimator *e, int tiles)
{
    rtid_estimator_debt *debt = &e->debt;
    while (debt->p < debt->n && tiles > 0) {
        if (debt->q >= debt->partners[debt->p]) {
            debt->p++;
            debt->q = 0;
            continue;
        }
        add_tile(e, debt->slot[debt->p], debt->slot[debt->q], debt->left[debt->p],
                 debt->d[debt->q]);
        debt->q++;
        tiles--;
    }
}

/* Owe what closed blocks share: those that rang all the time, then the young in their order. */
static void settle_closed(rtid_estimator *e)
{
    rtid_sum own[T], left[T];
    for (int p = 0; p < e->n_recent; p++) {
        const rtid_estimator_recent *item = &e->recent[p];
        if (item->status != RINGING)
            continue;
        weigh(e, item, own, left);
        owe(e, item->slot, left, item->d, e->debt.n + 1);
        add_shared(e, item);
    }
    for (int a = 0; a < e->n_young; a++) {
        const rtid_estimator_recent *item = &e->recent[e->young[a]];
        weigh(e, item, own, left);
        add_tile(e, item->slot, item->slot, own, item->d);
        owe(e, item->slot, left, item->d, e->debt.n);
        add_shared(e, item);
    }
}

/* Add what open blocks share among themselves, owe what they share with the closed ones. */
static void settle_open(rtid_estimator *e)
{
    const int closed = e->debt.n;
    rtid_sum left[T];
    for (int k = 0; k < e->n_open; k++) {
        add_own(e, k);
        for (int other = 0; other < k; other++)
            add_open_pair(e, k, other);
        read_through(e, k, left);
        owe(e, e->open[k].slot, left, e->recent[e->open[k].recent].d, closed);
    }
}

void rtid_est_rebase(rtid_estimator *e, int how)
{
    rtid_est_pay(e, ALL_TILES);
    e->debt.n = e->debt.p = e->debt.q = 0;
    settle_closed(e);
    settle_open(e);
    for (int i = 0; i < 1 + RTID_EST_SHARED; i++)
        for (int j = 0; j <= i; j++)
            merge(sum_at(e, i, j), e->local[i][j]);
    e->n_young = 0;
    for (int p = e->n_recent - 1; p >= 0; p--) {
        rtid_estimator_recent *item = &e->recent[p];
        rtid_real largest = 0;
        if (item->status < YOUNG)
            continue;
        item->status = RINGING;
        item->w_start = as_sum(0);
        for (int i = 0; i < T; i++) {
            item->d[i] *= e->d[RTID_EST_RING];
            item->through[i] = as_sum(0);
            largest = ABS(item->d[i]) > largest ? ABS(item->d[i]) : largest;
        }
        for (int j = 0; j < 1 + RTID_EST_SHARED; j++)
            item->shared_start[j] = as_sum(0);
        if (how == END_ALL || (how == FORGET_SILENT && !(largest > SILENT * item->size))) {
            e->n_closed--;
            release(e, p);
        }
    }
    clear_columns(e, 0, e->width);
    for (int j = 0; how == END_ALL && j < RTID_EST_WIDTH; j++)
        e->d[j] = 0;
    e->faded = how == SETTLE ? e->faded * e->d[RTID_EST_RING] : R(1);
    e->d[RTID_EST_RING] = R(1);
}

void rtid_est_end(rtid_estimator *e)
{
    rtid_est_rebase(e, END_ALL);
    while (e->n_open > 0) {
        release(e, e->open[e->n_open - 1].recent);
        rtid_est_remove_open(e, e->n_open - 1);
    }
}
