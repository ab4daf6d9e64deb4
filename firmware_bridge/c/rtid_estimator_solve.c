/* The joint estimate from frozen sums, as rtid/estimator/factor.py and correction.py make it. */
#include "rtid_estimator_sums.h"

#include <string.h>

static const double FLOW_PRIOR = 1e-2;   /* ten times the rated flow, 1 sigma */
static const double SHARED_PRIOR = 1e-2; /* beta is known to a factor of ten */
static const double LEAST_PIVOT = 1e-14; /* of a diagonal of about 1: rows and prior are above */

/* Lower triangle by rows; row and column 0 are y, so that row i is unknown i - 1. */
static double *row_of(rtid_estimator_work *w, int i)
{
    return &w->matrix[(i * (i + 1)) / 2];
}

static const double *row_in(const rtid_estimator_work *w, int i)
{
    return &w->matrix[(i * (i + 1)) / 2];
}

static int unknowns(const rtid_estimator_work *w)
{
    return RTID_EST_SHARED + (RTID_EST_TERMS * w->n_slots);
}

static size_t n_sums(const rtid_estimator_work *w)
{
    const size_t n = (size_t)unknowns(w) + 1u;
    return (n * (n + 1u)) / 2u;
}

static double prior(int i) { return (i < RTID_EST_SHARED) ? SHARED_PRIOR : FLOW_PRIOR; }

void rtid_estimator_freeze(const rtid_estimator *e, rtid_estimator_work *w)
{
    w->n_slots = e->n_slots;
    w->now_us = e->t_us;
    w->rows = (double)e->counts[RTID_EST_ROWS];
    w->noise = exact(e->noise);
    w->owed = e->owed;
    (void)memcpy(w->block, e->block, sizeof *w->block * (size_t)e->n_slots);
    /* MISRA 21.15: as they are, for a short copy; rtid_estimator_solve makes numbers of them */
    (void)memcpy(w->matrix, e->sums, n_sums(w) * sizeof *e->sums);
}

/* The bytes of the sums become numbers. */
static void read_sums(rtid_estimator_work *w)
{
    for (size_t k = 0u; k < n_sums(w); k++) {
        rtid_sum sum;
        (void)memcpy(&sum, &w->matrix[k], sizeof sum); /* MISRA 21.15: those bytes again */
        w->matrix[k] = exact(sum);
    }
}

/* ---- what is owed to the sums ---- */

static void add_between(rtid_estimator_work *w, int slot, int other, const double *left,
                        const double *d)
{
    const int mine = RTID_EST_BLOCKS_AT + (T * slot), its = RTID_EST_BLOCKS_AT + (T * other);
    for (int i = 0; i < T; i++) {
        for (int j = 0; j < T; j++) {
            if (mine > its) {
                row_of(w, mine + i)[its + j] += left[i] * d[j];
            } else if (mine < its) {
                row_of(w, its + j)[mine + i] += left[i] * d[j];
            } else if (j <= i) {
                row_of(w, mine + i)[mine + j] += (left[i] * d[j]) + (left[j] * d[i]);
            } else {
                /* the upper half of its own tile */
            }
        }
    }
}

/* Of a visit with those before the n-th of the line. */
static void settle_before(rtid_estimator_work *w, const rtid_estimator_visit *v, int n)
{
    rtid_sum sum[T];
    double left[T], d[T];
    rtid_est_left(&w->owed, v, sum);
    for (int i = 0; i < T; i++) {
        left[i] = exact(sum[i]);
    }
    int first = 0;
    if (n <= w->owed.n_paid) {
        first = 1;
    }
    for (int b = first; b < n; b++) {
        const rtid_estimator_visit *before = &w->owed.visit[w->owed.line[b]];
        if ((before->memory != v->memory) || !rtid_est_rings(before)) {
            continue;
        }
        for (int i = 0; i < T; i++) {
            d[i] = (double)(rtid_est_units(v, before) * before->d[i]);
        }
        add_between(w, v->slot, before->slot, left, d);
    }
}

/* Of a visit with itself, y and the shared columns since it closed. */
static void settle_alone(rtid_estimator_work *w, const rtid_estimator_visit *v)
{
    const int at = RTID_EST_BLOCKS_AT + (T * v->slot);
    const double ring = exact(rtid_est_ring(&w->owed, v));
    for (int i = 0; i < T; i++) {
        double *row = row_of(w, at + i);
        for (int j = 0; j < RTID_EST_BLOCKS_AT; j++) {
            row[j] += exact(rtid_est_shared(&w->owed, v, j)) * v->d[i];
        }
        for (int j = 0; j <= i; j++) {
            row[at + j] += ring * v->d[i] * v->d[j];
        }
    }
}

/* Row or column of the sums of a local column. */
static int place_of(const rtid_estimator_owed *o, int column)
{
    const int k = (column - RTID_EST_OPEN_AT) / T;
    if (column < RTID_EST_RING) {
        return column;
    }
    return RTID_EST_BLOCKS_AT + (T * o->open[k].slot) + (column - first_of(k));
}

void rtid_est_settle(rtid_estimator_work *w)
{
    rtid_estimator_owed *o = &w->owed;
    read_sums(w);
    for (int k = 0; k < o->n_open; k++) {
        rtid_est_take_left(o, k);
    }
    for (int a = 0; a < o->n_line; a++) {
        const rtid_estimator_visit *v = &o->visit[o->line[a]];
        settle_before(w, v, a);
        if (rtid_est_rings(v)) {
            settle_alone(w, v);
        }
    }
    for (int k = 0; k < o->n_open; k++) {
        settle_before(w, &o->visit[o->open[k].visit], o->n_line);
    }
    for (int i = 0; i < first_of(o->n_open); i++) {
        for (int j = 0; j <= i; j++) {
            const int a = place_of(o, i), b = place_of(o, j);
            if ((i != RTID_EST_RING) && (j != RTID_EST_RING)) {
                row_of(w, (a > b) ? a : b)[(a > b) ? b : a] += exact(o->local[i][j]);
            }
        }
    }
}

/* ---- the estimate ---- */

/* Add the prior, scale to a diagonal of 1/4 to 2: powers of two leave the sums as they are. */
static void scale_sums(rtid_estimator_work *w)
{
    for (int i = 1; i <= unknowns(w); i++) {
        double *row = row_of(w, i);
        int exponent = 0;
        row[i] += prior(i - 1);
        (void)frexp((row[i] > 0.0) ? row[i] : prior(i - 1), &exponent);
        w->scale[i - 1] = ldexp(1.0, -exponent / 2);
        for (int j = 1; j <= i; j++) {
            row[j] *= w->scale[i - 1] * w->scale[j - 1];
        }
    }
}

/* One Jacobi rotation that clears a[p][q] of a symmetric matrix. */
static void rotate(double a[T][T], int n, int p, int q)
{
    const double half = 0.5 * (a[q][q] - a[p][p]), both = a[p][q];
    const double t = both / (half + (((half < 0.0) ? -1.0 : 1.0) * sqrt((half * half) + (both * both))));
    const double c = 1.0 / sqrt(1.0 + (t * t)), s = t * c;
    if (both == 0.0) {
        return;
    }
    for (int k = 0; k < n; k++) {
        const double x = a[k][p], y = a[k][q];
        a[k][p] = (c * x) - (s * y);
        a[k][q] = (s * x) + (c * y);
    }
    for (int k = 0; k < n; k++) {
        const double x = a[p][k], y = a[q][k];
        a[p][k] = (c * x) - (s * y);
        a[q][k] = (s * x) + (c * y);
    }
}

/* Condition number of the information on the terms that a block's map has; HUGE_VAL: singular. */
static double condition(rtid_estimator_work *w, int slot)
{
    double a[T][T], low, high;
    int used[T], n = 0;
    (void)memset(a, 0, sizeof a);
    for (int i = 0; i < T; i++) {
        if (rtid_est_has_term(w->block[slot].edge, i)) {
            used[n] = RTID_EST_BLOCKS_AT + (T * slot) + i;
            n++;
        }
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j <= i; j++) {
            a[i][j] = row_of(w, used[i])[used[j]];
            a[j][i] = a[i][j];
        }
    }
    for (int sweep = 0; sweep < 8; sweep++) {
        for (int q = 1; q < n; q++) {
            for (int p = 0; p < q; p++) {
                rotate(a, n, p, q);
            }
        }
    }
    low = a[0][0];
    high = a[0][0];
    for (int i = 1; i < n; i++) {
        low = fmin(low, a[i][i]);
        high = fmax(high, a[i][i]);
    }
    return (low > 0.0) ? (high / low) : HUGE_VAL;
}

static double dot(const double *a, const double *b, int first, int last)
{
    double sum = 0.0;
    for (int j = first; j < last; j++) {
        sum += a[j] * b[j];
    }
    return sum;
}

/* Cholesky factor in place.  A pivot that is not above rounding is raised to that level, so that
 * the factor always exists; their number. */
static int factorize(rtid_estimator_work *w)
{
    const int n = unknowns(w);
    int raised = 0;
    for (int i = 1; i <= n; i++) {
        double *row = row_of(w, i);
        for (int j = 1; j < i; j++) {
            row[j] = (row[j] - dot(row, row_of(w, j), 1, j)) / row_of(w, j)[j];
        }
        row[i] -= dot(row, row, 1, i);
        if (!(row[i] > LEAST_PIVOT)) {
            row[i] = LEAST_PIVOT;
            raised++;
        }
        row[i] = sqrt(row[i]);
    }
    return raised;
}

/* x <- (L L')^-1 x */
static void substitute(rtid_estimator_work *w, double *x)
{
    const int n = unknowns(w);
    for (int i = 0; i < n; i++) {
        const double *row = &row_of(w, i + 1)[1];
        x[i] = (x[i] - dot(row, x, 0, i)) / row[i];
    }
    for (int i = n - 1; i >= 0; i--) {
        const double *row = &row_of(w, i + 1)[1];
        x[i] /= row[i];
        for (int j = 0; j < i; j++) {
            x[j] -= row[j] * x[i];
        }
    }
}

/* L <- L^-1 in place, row by row: X_i: = - (L_i: X) / L_ii. */
static void invert(rtid_estimator_work *w)
{
    const int n = unknowns(w);
    for (int i = 1; i <= n; i++) {
        double *row = row_of(w, i);
        for (int j = 1; j < i; j++) {
            const double factor = row[j];
            const double *above = row_of(w, j);
            row[j] = 0.0;
            for (int k = 1; k <= j; k++) {
                row[k] += factor * above[k];
            }
        }
        row[i] = 1.0 / row[i];
        for (int j = 1; j < i; j++) {
            row[j] *= -row[i];
        }
    }
}

/* Entry of the unscaled covariance, from the inverse of the factor. */
static double covariance(const rtid_estimator_work *w, int i, int j)
{
    double sum = 0.0;
    for (int k = ((i > j) ? i : j) + 1; k <= unknowns(w); k++) {
        sum += row_in(w, k)[i + 1] * row_in(w, k)[j + 1];
    }
    return sum * w->scale[i] * w->scale[j];
}

static double limited(double x, double low, double high) { return fmin(fmax(x, low), high); }

/* Take the pressure noise out of the information on 1 / beta; returns what it is moved by. */
static double correct(rtid_estimator_work *w, double information, double leverage)
{
    const double rows = (w->rows > 1.0) ? w->rows : 1.0, noise = w->noise * (1.0 - leverage);
    const double least = SHARED_PRIOR + (3.0 * sqrt(2.0 / rows) * w->noise);
    const double told = (information - noise) / least, missing = limited(2.0 - told, 0.0, 1.0);
    const double cov = 1.0 / ((told > 1.0) ? (told * least) : least);
    w->cov_change = cov + (cov * noise * (1.0 + (w->noise / rows)) * cov);
    w->cov_change += (missing * missing) - (1.0 / information);
    return ((cov * information) - 1.0) * w->theta[0];
}

/* Least squares with the prior, then beta without its bias, and the flow terms that follow it. */
static void estimate(rtid_estimator_work *w, rtid_estimator_solution *s)
{
    const int n = unknowns(w);
    double effective = 0.0, terms = 0.0, square = w->matrix[0], information, shift, dof;
    for (int i = 0; i < n; i++) {
        const double share = 1.0 - (prior(i) * covariance(w, i, i));
        w->theta[i] *= w->scale[i];
        w->basis[i] *= w->scale[i];
        effective += share;
        terms += (i < RTID_EST_SHARED) ? 0.0 : share;
        square -= w->theta[i] * (row_of(w, i + 1)[0] + (prior(i) * w->theta[i]));
    }
    s->leverage = limited(terms / ((w->rows > 1.0) ? w->rows : 1.0), 0.0, 0.9);
    information = 1.0 / w->basis[0];
    shift = correct(w, information, s->leverage);
    square += shift * shift * information;
    for (int i = 0; i < n; i++) {
        const double follow = w->basis[i] * information * shift;
        w->basis[i] *= information;
        square -= prior(i) * follow * ((2.0 * w->theta[i]) + follow);
        w->theta[i] += follow;
    }
    dof = rint(w->rows - effective);
    s->rho = square / ((dof > 1.0) ? dof : 1.0);
}

/* Variance of a sum of unknowns from `at` on, the correction included. */
static double variance_of(const rtid_estimator_work *w, int at, int count, const double *weight)
{
    double variance = 0.0, along = 0.0;
    for (int i = 0; i < count; i++) {
        along += weight[i] * w->basis[at + i];
        for (int j = 0; j < count; j++) {
            variance += weight[i] * weight[j] * covariance(w, at + i, at + j);
        }
    }
    variance += along * along * w->cov_change;
    return (variance > 0.0) ? variance : 0.0;
}

static double with_rounding(double sd, double rounding)
{
    return sqrt((sd * sd) + (rounding * rounding));
}

static void read_shared(const rtid_estimator_work *w, rtid_estimator_solution *s)
{
    const double one = 1.0;
    for (int i = 0; i < RTID_EST_SHARED; i++) {
        const double scale = rtid_est_shared_scale(i);
        s->shared[i] = scale * w->theta[i];
        s->shared_sd[i] = with_rounding(fabs(scale) * sqrt(variance_of(w, i, 1, &one)),
                                        SHARED_ROUNDING * s->shared[i]);
    }
}

/* ---- blocks ---- */

static void read_map(rtid_estimator_work *w, int slot)
{
    const rtid_estimator_block *block = &w->block[slot];
    rtid_estimator_map *map = &w->map[slot];
    const int at = RTID_EST_SHARED + (RTID_EST_TERMS * slot);
    const double scale = rtid_est_rated(block->edge), dwell_s = (double)block->dwell_us * 1e-6;
    double phi[RTID_EST_TERMS];
    map->mean_m3s = 0.0;
    for (int i = 0; i < RTID_EST_TERMS; i++) {
        phi[i] = exact(block->phi[i]) / ((dwell_s > 1e-12) ? dwell_s : 1e-12);
        map->theta[i] = scale * w->theta[at + i];
        map->mean_m3s += phi[i] * map->theta[i];
    }
    map->mean_sd_m3s = with_rounding(scale * sqrt(variance_of(w, at, RTID_EST_TERMS, phi)),
                                     FLOW_ROUNDING * scale);
}

/* Largest block-mean flow of an edge, its rated flow where none is known. */
static double largest_flow(const rtid_estimator_work *w, int edge)
{
    double largest = 0.0;
    for (int slot = 0; slot < w->n_slots; slot++) {
        if ((w->block[slot].edge == edge) && (w->block[slot].rows >= RTID_EST_MIN_ROWS)) {
            largest = fmax(largest, fabs(w->map[slot].mean_m3s));
        }
    }
    return (largest > 0.0) ? largest : rtid_est_rated(edge);
}

static uint8_t status_of(const rtid_estimator_work *w, int slot)
{
    const rtid_estimator_block *block = &w->block[slot];
    const rtid_estimator_map *map = &w->map[slot];
    if ((block->rows < RTID_EST_MIN_ROWS) || !(map->condition <= RTID_EST_CONDITION_LIMIT)
        || !(map->mean_sd_m3s <= (RTID_EST_MAX_SD_SHARE * largest_flow(w, block->edge)))) {
        return RTID_EST_LEARNING;
    }
    return ((w->now_us - block->last_us) > RTID_EST_STALE_US) ? RTID_EST_STALE : RTID_EST_VALID;
}

void rtid_estimator_solve(rtid_estimator_work *w, rtid_estimator_solution *s)
{
    (void)memset(s, 0, sizeof *s);
    rtid_est_settle(w);
    for (int slot = 0; slot < w->n_slots; slot++) {
        w->map[slot].condition = condition(w, slot);
    }
    scale_sums(w);
    s->raised = (uint16_t)factorize(w);
    for (int i = 0; i < unknowns(w); i++) {
        w->theta[i] = row_of(w, i + 1)[0] * w->scale[i];
        w->basis[i] = (i == 0) ? w->scale[0] : 0.0;
    }
    substitute(w, w->theta);
    substitute(w, w->basis);
    invert(w);
    estimate(w, s);
    read_shared(w, s);
    for (int slot = 0; slot < w->n_slots; slot++) {
        read_map(w, slot);
    }
    for (int slot = 0; slot < w->n_slots; slot++) {
        w->map[slot].status = status_of(w, slot);
    }
    s->finite = (isfinite(s->rho) && isfinite(s->shared[0])) ? 1u : 0u;
}
