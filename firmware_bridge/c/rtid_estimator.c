/* Samples: what is refused, where the memory begins and ends. */
#include "rtid_estimator_sums.h"
#include "rtid_version.h"

#include <string.h>

const char rtid_estimator_version[] = "rtid_estimator " RTID_C_VERSION ", " RTID_EST_LEARNS;

/* no range reaches what is no number */
#define CAPPED(x) (((x) < -MOST) ? R(-MOST) : (((x) > MOST) ? R(MOST) : R(x)))

static const rtid_real RANGES[][2] = {RTID_EST_RANGES};

static bool on_clock(int64_t t_us) { return (t_us >= 0) && (t_us <= INT64_C(0x1FFFFFFFFFFFFF)); }

static int acceptable(const rtid_estimator_sample *sample)
{
    int verdict = RTID_EST_TAKEN;
    if (!on_clock(sample->t_us)) {
        return RTID_EST_OUT_OF_RANGE;
    }
    for (int j = 0; j < RTID_EST_N_SIGNALS; j++) {
        const rtid_real value = sample->values[j];
        if (!((value >= RANGES[j][0]) && (value <= RANGES[j][1]))) {
            if (!(ABS(value) < INSANE)) {
                return RTID_EST_NOT_FINITE;
            }
            verdict = RTID_EST_OUT_OF_RANGE;
        }
    }
    return verdict;
}

void rtid_est_remember(rtid_estimator *e, const rtid_estimator_sample *sample)
{
    e->t_us = sample->t_us;
    (void)memcpy(e->values, sample->values, sizeof sample->values);
}

/* End all memory at a break of continuity; learned sums stay. */
static void stop(rtid_estimator *e)
{
    rtid_est_stop(e);
    for (int i = 0; i < RTID_EST_N_EDGES; i++) {
        e->edge[i].u = SHUT;
    }
    e->running = 0u;
}

void rtid_estimator_start(rtid_estimator *e)
{
    (void)memset(e, 0, sizeof *e);
    rtid_est_set_open(e, 0);
    e->d[RTID_EST_RING] = R(1);
    e->faded = R(1);
    e->ready_us = -1;
    for (int i = 0; i < RTID_EST_N_EDGES; i++) {
        e->edge[i].u = SHUT;
        e->edge[i].place = -1;
    }
    for (int c = 0; c < RTID_EST_N_CELLS; c++) {
        e->slot[c] = -1;
    }
}

static int take(rtid_estimator *e, const rtid_estimator_sample *sample)
{
    int verdict = acceptable(sample);
    const bool whole = verdict == RTID_EST_TAKEN, was_running = e->running != 0u;
    e->counts[RTID_EST_SAMPLES]++;
    e->tiles = RTID_EST_TILES_PER_TICK;
    if (whole && was_running) {
        const int64_t dt_us = sample->t_us - e->t_us;
        if ((sample->gap != 0u) || (dt_us > RTID_EST_MAX_GAP_US) || (dt_us <= 0)) {
            verdict = RTID_EST_RESTART_GAP;
        } else {
            verdict = rtid_est_place(e, sample->values, dt_us);
        }
    }
    if (verdict != RTID_EST_TAKEN) {
        e->counts[verdict]++;
    }
    if ((!whole) || (verdict == RTID_EST_RESTART_GAP)) {
        e->ready_us = RTID_EST_RECOVERY_US + (on_clock(sample->t_us) ? sample->t_us : e->t_us);
    }
    if (was_running && (verdict == RTID_EST_TAKEN)) {
        rtid_est_integrate(e, sample); /* and remembers it */
        return verdict;
    }
    if (was_running) {
        stop(e);
    }
    if (!whole) {
        return verdict;
    }
    rtid_est_remember(e, sample);
    if ((!was_running || (verdict == RTID_EST_RESTART_GAP)) && (sample->row != 0u)) {
        if (sample->t_us < e->ready_us) {
            e->counts[RTID_EST_RECOVERING]++;
            return RTID_EST_RECOVERING;
        }
        if (rtid_est_is_full(e)) {
            e->counts[RTID_EST_BUSY]++;
            return RTID_EST_BUSY;
        }
        rtid_est_begin(e);
    }
    return verdict;
}

int rtid_estimator_update(rtid_estimator *e, const rtid_estimator_sample *sample)
{
    const int verdict = take(e, sample);
    rtid_est_pay(e); /* with what the sample has left of the tick */
    return verdict;
}
