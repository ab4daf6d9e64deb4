/* One block of the classical method, by hand: filter, basis, recursive least squares.

   Per sample: seven columns (six Taylor terms of the block and V dP/dt) and y pass the
   second-order filter (10), then one covariance step with lambda = 1:

       k = P phi / (1 + phi' P phi),   theta += k (y - phi' theta),   P -= k (P phi)'          */

enum { N = 7, COLUMNS = 8 };

typedef struct {
    double a[2][2], b[2][2];       /* filter: x+ = a x + b [start, end] */
    double x[2][COLUMNS];          /* filter states, the column y last */
    double before[COLUMNS];        /* unfiltered columns of the sample before */
    double theta[N], p[N][N];
} Rls;

static void columns(const double *sample, double *out)
{
    const double xi = sample[0], eta = sample[1];
    out[0] = 1.0;
    out[1] = xi;
    out[2] = eta;
    out[3] = xi * xi;
    out[4] = eta * eta;
    out[5] = xi * eta;
    out[6] = sample[2];
    out[7] = sample[3];
}

static void filter(Rls *s, const double *now)
{
    for (int j = 0; j < COLUMNS; j++) {
        const double x0 = s->x[0][j], x1 = s->x[1][j];
        s->x[0][j] = s->a[0][0] * x0 + s->a[0][1] * x1 + s->b[0][0] * s->before[j] + s->b[0][1] * now[j];
        s->x[1][j] = s->a[1][0] * x0 + s->a[1][1] * x1 + s->b[1][0] * s->before[j] + s->b[1][1] * now[j];
        s->before[j] = now[j];
    }
}

static void update(Rls *s)
{
    const double *phi = s->x[0];
    double p_phi[N], innovation = phi[N], variance = 1.0;
    for (int i = 0; i < N; i++) {
        p_phi[i] = 0.0;
        for (int j = 0; j < N; j++) p_phi[i] += s->p[j][i] * phi[j];
    }
    for (int i = 0; i < N; i++) {
        variance += p_phi[i] * phi[i];
        innovation -= phi[i] * s->theta[i];
    }
    const double scale = 1.0 / variance;
    for (int i = 0; i < N; i++) {
        s->theta[i] += scale * p_phi[i] * innovation;
        for (int j = 0; j < N; j++) s->p[i][j] -= scale * p_phi[i] * p_phi[j];
    }
}

/* samples (n, 4): xi, eta, V dP/dt, y.  The state is changed in place. */
void rls_run(Rls *s, const double *samples, long n)
{
    double now[COLUMNS];
    for (long k = 0; k < n; k++) {
        columns(samples + 4 * k, now);
        filter(s, now);
        update(s);
    }
}
