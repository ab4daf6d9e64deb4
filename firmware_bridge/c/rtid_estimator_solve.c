/* The joint estimate from frozen sums, as rtid/estimator/factor.py and correction.py make it. */
#include "rtid_estimator_sums.h"

#include <string.h>

static const double FLOW_PRIOR = 1e-2;   /* ten times the rated flow, 1 sigma */
static const double SHARED_PRIOR = 1e-2; /* beta is known to a factor of ten */

/* Lower triangle by rows; row and column 0 are y, so that row i is unknown i - 1. */
static double *row_of(rtid_estimator_work *w, int i) { return &w->matrix[(uint32_t)i * (uint32_t)(i + 1) / 2]; }

static const double *row_in(const rtid_estimator_work *w, int i)
{
    return &w->matrix[(uint32_t)i * (uint32_t)(i + 1) / 2];
}

static int unknowns(const rtid_estimator_work *w) { return RTID_EST_SHARED + RTID_EST_TERMS * w->n_slots; }

static double prior(int i) { return i < RTID_EST_SHARED ? SHARED_PRIOR : FLOW_PRIOR; }

void rtid_estimator_freeze(rtid_estimator *e, rtid_estimator_work *w)
{
    if (e->running)
        rtid_est_rebase(e, GO_ON);
    w->n_slots = e->n_slots;
    w->rows = e->counts[RTID_EST_ROWS];
    w->noise = exact(e->noise);
    memcpy(w->block, e->block, sizeof *w->block * e->n_slots);
    /* as they are: the numbers are made of them by rtid_estimator_solve */
    memcpy(w->matrix, e->sums, (size_t)(row_of(w, unknowns(w) + 1) - w->matrix) * sizeof(rtid_sum));
}

/* The bytes of the sums become numbers, scaled to a unit diagonal with the prior. */
static void scale_sums(rtid_estimator_work *w)
{
    const int n = unknowns(w);
    const double *end = row_of(w, n + 1);
    for (double *p = w->matrix; p < end; p++) {
        rtid_sum sum;
        memcpy(&sum, p, sizeof sum);
        *p = exact(sum);
    }
    for (int i = 1; i <= n; i++) {
        double *row = row_of(w, i);
        row[i] += prior(i - 1);
        w->scale[i - 1] = 1.0 / sqrt(row[i]);
        for (int j = 1; j <= i; j++)
            row[j] *= w->scale[i - 1] * w->scale[j - 1];
    }
}

static double dot(const double *a, const double *b, int first, int last)
{
    double sum = 0.0;
    for (int j = first; j < last; j++)
        sum += a[j] * b[j];
    return sum;
}

/* Cholesky factor in place; 0 if the matrix is not definite. */
static int factorize(rtid_estimator_work *w)
{
    const int n = unknowns(w);
    for (int i = 1; i <= n; i++) {
        double *row = row_of(w, i);
        for (int j = 1; j < i; j++)
            row[j] = (row[j] - dot(row, row_of(w, j), 1, j)) / row_of(w, j)[j];
        row[i] -= dot(row, row, 1, i);
        if (!(row[i] > 0.0))
            return 0;
        row[i] = sqrt(row[i]);
    }
    return 1;
}

/* x <- (L L')^-1 x */
static void substitute(rtid_estimator_work *w, double *x)
{
    const int n = unknowns(w);
    for (int i = 0; i < n; i++) {
        const double *row = row_of(w, i + 1) + 1;
        x[i] = (x[i] - dot(row, x, 0, i)) / row[i];
    }
    for (int i = n - 1; i >= 0; i--) {
        const double *row = row_of(w, i + 1) + 1;
        x[i] /= row[i];
        for (int j = 0; j < i; j++)
            x[j] -= row[j] * x[i];
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
            for (int k = 1; k <= j; k++)
                row[k] += factor * above[k];
        }
        row[i] = 1.0 / row[i];
        for (int j = 1; j < i; j++)
            row[j] *= -row[i];
    }
}

/* Entry of the unscaled covariance, from the inverse of the factor. */
static double covariance(const rtid_estimator_work *w, int i, int j)
{
    double sum = 0.0;
    for (int k = (i > j ? i : j) + 1; k <= unknowns(w); k++)
        sum += row_in(w, k)[i + 1] * row_in(w, k)[j + 1];
    return sum * w->scale[i] * w->scale[j];
}

static double limited(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

/* Take the pressure noise out of the information on 1 / beta; returns what it is moved by. */
static double correct(rtid_estimator_work *w, double information, rtid_estimator_solution *s)
{
    const double rows = w->rows > 1.0 ? w->rows : 1.0, noise = w->noise * (1.0 - s->leverage);
    const double least = SHARED_PRIOR + 3.0 * sqrt(2.0 / rows) * w->noise;
    const double told = (information - noise) / least, missing = limited(2.0 - told, 0.0, 1.0);
    const double cov = 1.0 / (told > 1.0 ? told * least : least);
    w->cov_change = cov + cov * noise * (1.0 + w->noise / rows) * cov - 1.0 / information + missing * missing;
    return (cov * information - 1.0) * w->theta[0];
}

void rtid_estimator_solve(rtid_estimator_work *w, rtid_estimator_solution *s)
{
    const int n = unknowns(w);
    double effective = 0.0, terms = 0.0, square, information, shift, dof;
    memset(s, 0, sizeof *s);
    scale_sums(w);
    if (!factorize(w))
        return;
    s->definite = 1;
    for (int i = 0; i < n; i++) {
        w->theta[i] = row_of(w, i + 1)[0] * w->scale[i];
        w->basis[i] = 0.0;
    }
    w->basis[0] = w->scale[0];
    substitute(w, w->theta);
    substitute(w, w->basis);
    invert(w);
    square = w->matrix[0];
    for (int i = 0; i < n; i++) {
        const double share = 1.0 - prior(i) * covariance(w, i, i);
        w->theta[i] *= w->scale[i];
        w->basis[i] *= w->scale[i];
        effective += share;
        terms += i < RTID_EST_SHARED ? 0.0 : share;
        square -= w->theta[i] * (row_of(w, i + 1)[0] + prior(i) * w->theta[i]);
    }
    s->leverage = limited(terms / (w->rows > 1.0 ? w->rows : 1.0), 0.0, 0.9);
    information = 1.0 / w->basis[0];
    shift = correct(w, information, s);
    square += shift * shift * information;
    for (int i = 0; i < n; i++) {
        double *theta = &w->theta[i];
        w->basis[i] *= information;
        square -= prior(i) * (w->basis[i] * shift) * (2.0 * *theta + w->basis[i] * shift);
        *theta += w->basis[i] * shift;
    }
    dof = rint(w->rows - effective);
    s->rho = square / (dof > 1.0 ? dof : 1.0);
    s->compliance = w->theta[0] * RTID_EST_COMPLIANCE;
    s->compliance_sd = sqrt(1.0 / information + w->cov_change) * RTID_EST_COMPLIANCE;
}

int rtid_estimator_map_of(const rtid_estimator_work *w, int slot, rtid_estimator_map *map)
{
    double phi[RTID_EST_TERMS], variance = 0.0, along = 0.0, scale;
    const int at = RTID_EST_SHARED + RTID_EST_TERMS * slot;
    if (slot < 0 || slot >= w->n_slots)
        return 0;
    scale = rtid_est_rated(w->block[slot].edge);
    map->mean_m3s = 0.0;
    for (int i = 0; i < RTID_EST_TERMS; i++) {
        const double dwell_s = (double)w->block[slot].dwell_us * 1e-6;
        phi[i] = exact(w->block[slot].phi[i]) / (dwell_s > 1e-12 ? dwell_s : 1e-12);
        map->theta[i] = scale * w->theta[at + i];
        map->mean_m3s += phi[i] * map->theta[i];
        along += phi[i] * w->basis[at + i];
    }
    for (int i = 0; i < RTID_EST_TERMS; i++)
        for (int j = 0; j < RTID_EST_TERMS; j++)
            variance += phi[i] * phi[j] * covariance(w, at + i, at + j);
    variance += along * along * w->cov_change;
    map->mean_sd_m3s = scale * sqrt(variance > 0.0 ? variance : 0.0);
    return 1;
}
