/* A controller around the sources of ../c: what runs when, and what holds through a loss of power.
 *
 *     every millisecond   an interrupt: frames that came, one update, a flow from the active map
 *     idle                interrupted by it: the map download, the solve, what is to be kept
 *
 * The solve takes many milliseconds; nothing waits for it, since it works on sums that were frozen.
 * Maps change by their second side (rtid_download.h) between two ticks, all at once.
 */
#include <string.h>

#include "board.h"
#include "can_log.h"
#include "rtid_download.h"
#include "rtid_estimator.h"
#include "store.h"

enum { SLOTS = 3, NODES = 510, COUNTS = 8192, MAIL = 256, FRAMES = 60000 };
enum { SOLVE_MS = 500, KEEP_MS = 2000, ALL_FRESH = (1 << RTID_N_MESSAGES) - 1 };
#define DOWNLOAD_ID 0x700u
#define PER_COUNT 40u /* instructions */

/* Lies at the same place in every run of this build, so a plain copy keeps its pointers too. */
typedef struct {
    rtid_estimator estimator;
    rtid_download download;
    rtid_slot slots[SLOTS];
    float nodes[SLOTS][2][NODES];
    int16_t counts[SLOTS][2][COUNTS];
    uint8_t status[SLOTS][2][COUNTS];
} memory;

typedef struct {
    uint32_t restored, ticks, longest, latest; /* bank; instructions of a tick, and before it */
    uint32_t solves, kept, answers, version;
    uint64_t rows;
    double beta_pa, beta_sd_pa;
    float flow_m3s;
    uint32_t stands_on;
} report;

static memory now, kept;
static rtid_estimator_work work;
static rtid_estimator_solution solution;
static rtid_receiver receiver;
static rtid_frame frames[FRAMES];
static size_t n_frames;
static volatile size_t next_frame;
static volatile uint32_t now_ms;
static double latest[RTID_N_MESSAGES][RTID_MAX_VALUES];
static uint32_t fresh;
static uint8_t mail[MAIL][8];
static volatile uint32_t posted;
static uint32_t fetched;
static report told;

/* ---- every millisecond ---- */

static void learn(int64_t t_us)
{
    const double *command = latest[RTID_VALVE_COMMAND], *pressure = latest[RTID_PRESSURES];
    rtid_estimator_sample sample = {.t_us = t_us, .row = 1};
    sample.values[RTID_EST_COLUMN_U] = (rtid_real)command[RTID_VALVE_COMMAND_U];
    sample.values[RTID_EST_COLUMN_P_TANK] = (rtid_real)command[RTID_VALVE_COMMAND_PTANK];
    sample.values[RTID_EST_COLUMN_P_A] = (rtid_real)pressure[RTID_PRESSURES_PA];
    sample.values[RTID_EST_COLUMN_P_SUPPLY] = (rtid_real)pressure[RTID_PRESSURES_PSUPPLY];
    sample.values[RTID_EST_COLUMN_X] = (rtid_real)latest[RTID_MOTION][RTID_MOTION_X];
    (void)rtid_estimator_update(&now.estimator, &sample);
    told.stands_on = (uint32_t)rtid_map_flow(
        rtid_download_map(&now.download, 0), (float)command[RTID_VALVE_COMMAND_U],
        (float)(pressure[RTID_PRESSURES_PSUPPLY] - pressure[RTID_PRESSURES_PA]), &told.flow_m3s);
}

static void take(const rtid_frame *frame)
{
    double values[RTID_MAX_VALUES];
    int message;
    if (frame->can_id == DOWNLOAD_ID) {
        memcpy(mail[posted % MAIL], frame->data, 8);
        posted++;
    } else if (rtid_check(&receiver, frame, &message, values) == RTID_OK) {
        memcpy(latest[message], values, sizeof values);
        fresh |= 1u << message;
        if (fresh == ALL_FRESH) {
            learn(frame->t_us);
            fresh = 0;
        }
    }
}

/* Instructions from one count to another, less than a millisecond later. */
static uint32_t passed(uint32_t from, uint32_t to)
{
    return (from + BOARD_MS + 1 - to) % (BOARD_MS + 1) * PER_COUNT;
}

void board_tick(void)
{
    const uint32_t start = board_now(), late = passed(0, start);
    const int64_t due_us = frames[0].t_us + (int64_t)++now_ms * 1000;
    uint32_t length;
    while (next_frame < n_frames && frames[next_frame].t_us < due_us) {
        take(&frames[next_frame]);
        next_frame++;
    }
    length = passed(start, board_now());
    told.longest = length > told.longest ? length : told.longest;
    told.latest = late > told.latest ? late : told.latest;
}

/* ---- idle ---- */

static void begin(void)
{
    memset(&now, 0, sizeof now);
    rtid_estimator_start(&now.estimator);
    now.download.slots = now.slots;
    now.download.n_slots = SLOTS;
    for (int k = 0; k < SLOTS; k++)
        for (int side = 0; side < 2; side++)
            now.slots[k].room[side] = (rtid_room){now.nodes[k][side], now.counts[k][side],
                                                  now.status[k][side], NODES, COUNTS};
}

/* Answers go to a file of the host: a CAN driver would send them. */
static void receive(int out)
{
    uint8_t answer[RTID_DOWNLOAD_ANSWERS][8];
    while (fetched != posted) {
        const int n = rtid_download_push(&now.download, now_ms, mail[fetched % MAIL], 8, answer);
        board_write(out, answer, 8 * (size_t)n);
        told.answers += (uint32_t)n;
        fetched++;
    }
}

static void solve(void)
{
    board_lock();
    rtid_estimator_freeze(&now.estimator, &work);
    board_unlock();
    rtid_estimator_solve(&work, &solution);
    told.solves++;
}

static void keep(void)
{
    board_lock();
    kept = now;
    board_unlock();
    store_write(&kept, sizeof kept, rtid_estimator_version);
    told.kept++;
}

static void tell(void)
{
    const int out = board_open("report.bin", WRITE);
    const double inverse = solution.shared[0];
    told.ticks = now_ms;
    told.rows = now.estimator.counts[RTID_EST_ROWS];
    told.version = now.download.present & 1u ? now.slots[0].version[now.download.side & 1u] : 0;
    told.beta_pa = 1.0 / inverse;
    told.beta_sd_pa = solution.shared_sd[0] / (inverse * inverse);
    board_write(out, &told, sizeof told);
    board_close(out);
}

int main(void)
{
    const int out = board_open("answers.bin", WRITE);
    uint32_t solved_ms = 0, kept_ms = 0, version = 0;
    n_frames = can_log_read("can.log", frames, FRAMES);
    if (n_frames == 0)
        return 2;
    told.restored = store_read(&kept, sizeof kept, rtid_estimator_version);
    if (told.restored == 0)
        begin();
    else
        now = kept;
    version = now.download.side;
    board_every_ms();
    while (next_frame < n_frames) {
        receive(out);
        if (now_ms - solved_ms >= SOLVE_MS) {
            solved_ms = now_ms;
            solve();
        }
        if (now_ms - kept_ms >= KEEP_MS || version != now.download.side) {
            kept_ms = now_ms;
            version = now.download.side;
            keep();
        }
        board_wait(); /* for the next tick */
    }
    board_lock();
    receive(out);
    solve();
    tell();
    return 0;
}
