/* The controller's estimator over arrays of samples, and the time of each update. */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

#include "rtid_estimator.h"

void begin(rtid_estimator *e) { rtid_estimator_start(e); }

void run(rtid_estimator *e, const rtid_estimator_sample *samples, int64_t n)
{
    for (int64_t k = 0; k < n; k++)
        rtid_estimator_update(e, &samples[k]);
}

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

void run_timed(rtid_estimator *e, const rtid_estimator_sample *samples, int64_t n, double *seconds)
{
    for (int64_t k = 0; k < n; k++) {
        const double start = now_s();
        rtid_estimator_update(e, &samples[k]);
        seconds[k] = now_s() - start;
    }
}

void solve(rtid_estimator *e, rtid_estimator_work *w, rtid_estimator_solution *s)
{
    rtid_estimator_freeze(e, w);
    rtid_estimator_solve(w, s);
}
