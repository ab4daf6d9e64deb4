/* Free run of the learned machine: rtid/kernels/free_run.py and map_point.py, line by line.
 *
 *     V_c(x) / beta_c dP_c/dt = sum of sigma Q(w, dp) + shared terms - s_c A_c dx/dt
 *
 * Commands are held over a step; other signals run with their rates.  Dormand-Prince 5(4) with
 * steps controlled to 0.01 Pa.
 */
#include "rtid_machine.h"

#include <math.h>
#include <string.h>

#include "rtid_map.h"

#define PI 3.14159265358979323846
#define TOLERANCE_PA 0.01
#define MOST_STEPS 500
#define INSANE_PA 1e9
#define STAGES 7
#define Z95 1.959963984540054

static const double A[STAGES][6] = {
    {0},
    {1.0 / 5},
    {3.0 / 40, 9.0 / 40},
    {44.0 / 45, -56.0 / 15, 32.0 / 9},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84},
};
static const double NODE[STAGES] = {0, 1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1, 1};
static const double ERROR[STAGES] = {71.0 / 57600, 0, -71.0 / 16695, 71.0 / 1920,
                                     -17253.0 / 339200, 22.0 / 525, -1.0 / 40};

static double clipped(double x, double low, double high) {
    return x < low ? low : x > high ? high : x;
}

static double rise(double t) {
    if (t <= -1.0) return 0.0;
    if (t >= 1.0) return 1.0;
    double angle = sin(0.25 * PI * (1.0 + t)), root = sin(0.5 * PI * angle * angle);
    return root * root;
}

static int located(const double *border, int n, double at) {
    int low = 0, high = n;
    while (high - low > 1) {
        int mid = (low + high) / 2;
        if (at >= border[mid]) low = mid; else high = mid;
    }
    return low;
}

/* The first of the two cells that share a point, and the share of the second. */
static int blend(const double *border, int n, double at, double *share) {
    *share = 0.0;
    if (n == 1) return 0;
    int first = located(border, n, at);
    if (at < 0.5 * (border[first] + border[first + 1])) first -= 1;
    first = first < 0 ? 0 : first > n - 2 ? n - 2 : first;
    double left = border[first + 1] - border[first], right = border[first + 2] - border[first + 1];
    *share = rise((at - border[first + 1]) / (OVERLAP * (left < right ? left : right)));
    return first;
}

static double cell_flow(int i, int iu, int ip, double w, double dp, double *slope) {
    const double *u = U_BORDER + FIRST_U[i] + iu, *p = DP_BORDER + FIRST_DP[i] + ip;
    const double *t = THETA[FIRST_CELL[i] + iu * N_DP[i] + ip];
    double hp = 2.0 / (p[1] - p[0]);
    double xi = 2.0 * (w - u[0]) / (u[1] - u[0]) - 1.0, eta = (dp - p[0]) * hp - 1.0;
    *slope = hp * (t[2] + 2.0 * eta * t[4] + xi * t[5]);
    return t[0] + xi * (t[1] + xi * t[3] + eta * t[5]) + eta * (t[2] + eta * t[4]);
}

/* Flow of an edge; beyond the grid along dp its tangent goes on, where that does not fall. */
static double flow_of(int i, double w, double dp, int *is_beyond) {
    if (!(w > SAFE_V[i])) return 0.0;
    const double *u = U_BORDER + FIRST_U[i], *p = DP_BORDER + FIRST_DP[i];
    double at = clipped(w, u[0], u[N_U[i]]), inside = clipped(dp, p[0], p[N_DP[i]]);
    double share_u, share_p, q = 0.0, slope = 0.0;
    int a = blend(u, N_U[i], at, &share_u), b = blend(p, N_DP[i], inside, &share_p);
    for (int du = 0; du < 2; du++)
        for (int dd = 0; dd < 2; dd++) {
            double by_dp, weight = (du ? share_u : 1.0 - share_u) * (dd ? share_p : 1.0 - share_p);
            if (weight == 0.0) continue;
            q += weight * cell_flow(i, a + du, b + dd, at, inside, &by_dp);
            slope += weight * by_dp;
        }
    if (dp != inside) *is_beyond = 1;
    q += (slope > 0.0 ? slope : 0.0) * (dp - inside);
    return q * (FOOT_V[i] > 0.0 ? rise((w - SAFE_V[i]) / FOOT_V[i] - 1.0) : 1.0);
}

/* Opening command of an edge: zero in a mode that keeps it shut. */
static double commanded(const Machine *m, int i) {
    int mode = MODE_COLUMN < N_SIGNALS ? (int)m->real[AT_SIGNAL + MODE_COLUMN] : 0;
    if (mode < 0 || mode > 62 || !((MODES[i] >> mode) & 1)) return 0.0;
    return DIRECTION[i] * m->real[AT_SIGNAL + COMMAND[i]];
}

static double signal_of(const double *now, int column) {
    return column < N_SIGNALS ? now[column] : 0.0;
}

#if N_CHAMBERS > 0
static double position_of(const Machine *m, double s, double dt) {
    if (X_COLUMN >= N_SIGNALS) return 0.0;
    return m->real[AT_SIGNAL + X_COLUMN] + s * dt * m->real[AT_RATE + X_COLUMN];
}

static double speed_of(const Machine *m) {
    return X_COLUMN < N_SIGNALS ? m->real[AT_RATE + X_COLUMN] : 0.0;
}

/* A shared term without the rates of the pressures; what stands before these is added to by. */
static double term_of(const Machine *m, int k, const double *now, double x, double by[2]) {
    double theta = TERM_THETA[k] * TERM_SCALE[k], z = TERM_CONSTANT[k], rate = 0.0, slope = 1.0;
    by[0] = by[1] = 0.0;
    for (int j = 0; j < N_SIGNALS; j++) {
        double weight = TERM_WEIGHT[k][j];
        z += weight * now[j];
        if (j == P_COLUMN[0]) by[0] += weight;
        else if (N_CHAMBERS == 2 && j == P_COLUMN[N_CHAMBERS - 1]) by[1] += weight;
        else if (weight != 0.0) rate += weight * m->real[AT_RATE + j];
    }
    if (TERM_VOLUME[k] == SHAPE_FLOW) {
        by[0] = by[1] = 0.0;
        if (TERM_SHAPE[k] == SHAPE_ROOT) return theta * copysign(sqrt(fabs(z)), z);
        if (TERM_SHAPE[k] == SHAPE_HINGE) return theta * (z > 0.0 ? z : 0.0);
        return theta * (TERM_SHAPE[k] == SHAPE_INVERSE ? -1.0 / z : z);
    }
    if (TERM_VOLUME[k] >= 0) theta *= V0_M3[TERM_VOLUME[k]] + GROWTH_M2[TERM_VOLUME[k]] * x;
    if (TERM_SHAPE[k] == SHAPE_ROOT) slope = 0.5 / sqrt(fabs(z) > 1.0 ? fabs(z) : 1.0);
    else if (TERM_SHAPE[k] == SHAPE_HINGE) slope = z > 0.0;
    else if (TERM_SHAPE[k] == SHAPE_INVERSE) slope = 1.0 / (z * z);
    for (int c = 0; c < 2; c++) by[c] *= theta * slope;
    return -theta * slope * rate;
}

/* out = dt dP/dt at the share s of a step; whether a pressure drop is beyond its grid. */
static int rates(const Machine *m, double s, double dt, const double *p, double *out) {
    double now[N_SIGNALS], f[2] = {0, 0}, g[2][2] = {{0, 0}, {0, 1}};
    double x = position_of(m, s, dt);
    int is_beyond = 0;
    for (int j = 0; j < N_SIGNALS; j++)
        now[j] = m->real[AT_SIGNAL + j] + s * dt * m->real[AT_RATE + j];
    for (int c = 0; c < N_CHAMBERS; c++) now[P_COLUMN[c]] = p[c];
    for (int i = 0; i < N_EDGES; i++) {
        double w = m->held[i], lag = m->real[AT_LAG];
        if (m->begin[i] != w && lag > 0.0) w += (m->begin[i] - w) * exp(-s * dt / lag);
        double q = flow_of(i, w, signal_of(now, SOURCE[i]) - signal_of(now, SINK[i]), &is_beyond);
        for (int c = 0; c < N_CHAMBERS; c++) f[c] += SIGN[i][c] * q;
    }
    for (int c = 0; c < N_CHAMBERS; c++) {
        f[c] -= AREA_M2[c] * speed_of(m);
        g[c][c] = (V0_M3[c] + GROWTH_M2[c] * x) / m->real[AT_BETA + c];
    }
    for (int k = 0; k < N_TERMS; k++) {
        double by[2], flow = term_of(m, k, now, x, by);
        for (int c = 0; c < N_CHAMBERS; c++) {
            f[c] += TERM_SIGN[k][c] * flow;
            for (int d = 0; d < 2; d++) g[c][d] += TERM_SIGN[k][c] * by[d];
        }
    }
    double det = g[0][0] * g[1][1] - g[0][1] * g[1][0];
    out[0] = dt * (g[1][1] * f[0] - g[0][1] * f[1]) / det;
    if (N_CHAMBERS == 2) out[N_CHAMBERS - 1] = dt * (g[0][0] * f[1] - g[1][0] * f[0]) / det;
    return is_beyond;
}

static int is_away(int c, double p) {
    double span = P_HIGH[c] - P_LOW[c];
    if (span < INSANE_PA) return !(p >= P_LOW[c] - span && p <= P_HIGH[c] + span);
    return !(fabs(p) < INSANE_PA);
}

/* Integrate p over a step of dt seconds; its status.  Time runs from 0 to 1. */
static int interval(Machine *m, double dt, double *p) {
    double slopes[STAGES][N_CHAMBERS], trial[N_CHAMBERS], s = 0.0, h = m->h < 1.0 ? m->h : 1.0;
    int code = INSIDE;
    for (int n = 0; n < MOST_STEPS; n++) {
        double error = 0.0;
        int is_beyond = 0;
        if (h > 1.0 - s) h = 1.0 - s;
        for (int stage = 0; stage < STAGES; stage++) {
            for (int c = 0; c < N_CHAMBERS; c++) {
                trial[c] = p[c];
                for (int j = 0; j < stage; j++) trial[c] += h * A[stage][j] * slopes[j][c];
            }
            is_beyond |= rates(m, s + NODE[stage] * h, dt, trial, slopes[stage]);
        }
        for (int c = 0; c < N_CHAMBERS; c++) {
            double missed = 0.0;
            for (int j = 0; j < STAGES; j++) missed += ERROR[j] * slopes[j][c];
            error = fmax(error, fabs(h * missed));
            if (isnan(missed)) error = INFINITY;
        }
        if (!(error < INSANE_PA)) {
            h *= 0.2;
            continue;
        }
        double factor = 0.9 * pow(TOLERANCE_PA / (error > 1e-30 ? error : 1e-30), 0.2);
        if (error <= TOLERANCE_PA) {
            s += h;
            if (is_beyond) code = BEYOND;
            for (int c = 0; c < N_CHAMBERS; c++) {
                p[c] = trial[c];
                if (is_away(c, p[c])) return RAN_AWAY;
            }
        }
        if (s >= 1.0 - 1e-12) {
            m->h = h * clipped(factor, 1.0, 4.0);
            return code;
        }
        h *= clipped(factor, 0.2, 4.0);
    }
    return RAN_AWAY;
}
#endif

void machine_reset(Machine *m) {
    memset(m, 0, sizeof *m);
    m->h = 1.0;
    m->is_old = 1;
    m->whole[N_EDGES] = INSIDE;
    memcpy(m->real, START, sizeof START);
}

/* Flow, interval and what it stands on, of each edge; the status as rtid_map.h numbers it. */
void machine_outputs(Machine *m) {
    const double *now = m->real + AT_SIGNAL;
    for (int i = 0; m->is_old && i < N_EDGES; i++) {
        double w = m->runs ? m->w[i] : commanded(m, i);
        double dp = signal_of(now, SOURCE[i]) - signal_of(now, SINK[i]);
        int is_beyond = 0;
        float sd;
        double q = flow_of(i, w, dp, &is_beyond);
        m->whole[i] = rtid_map_flow(TABLES[i], (float)(DIRECTION[i] * w), (float)dp, &sd);
        m->real[AT_FLOW + i] = q;
        m->real[AT_LOW + i] = q - Z95 * sd;
        m->real[AT_HIGH + i] = q + Z95 * sd;
    }
    m->is_old = 0;
}

int machine_step(Machine *m, double dt) {
    int code = INSIDE, is_off = 0;
    double lag = m->real[AT_LAG];
    double decay = lag > 0.0 ? exp(-dt / lag) : 0.0;
    for (int i = 0; i < N_EDGES; i++) {
        double u = commanded(m, i), begin = m->runs ? m->w[i] : u;
        double mean = lag > 0.0 && dt > 0.0 ? u + (begin - u) * lag / dt * (1.0 - decay) : u;
        m->held[i] = u;
        m->begin[i] = begin;
        m->w[i] = u + (begin - u) * decay;
        if (mean > SAFE_V[i])
            is_off |= mean < U_BORDER[FIRST_U[i]] || mean > U_BORDER[FIRST_U[i] + N_U[i]];
    }
    m->runs = m->is_old = 1;
#if N_CHAMBERS > 0
    double p[N_CHAMBERS];
    for (int c = 0; c < N_CHAMBERS; c++) p[c] = m->real[AT_SIGNAL + P_COLUMN[c]];
    if (dt > 0.0) code = interval(m, dt, p);
    for (int c = 0; c < N_CHAMBERS; c++) m->real[AT_SIGNAL + P_COLUMN[c]] = p[c];
#endif
    if (is_off && code != RAN_AWAY) code = OFF_GRID;
    m->real[AT_TIME] += dt;
    m->whole[N_EDGES] = code;
    return code;
}
