/* A controller for the tests: the receiver with its memory, and evaluation over arrays.
 *
 * As a library it is loaded by tests/bridge/controller.py.  As a program (-DPROGRAM, sanitised) it
 * takes frames of 8 bytes after one byte of length from standard input and writes the answers.
 */
#include "rtid_download.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    rtid_download d;
    rtid_slot slots[RTID_DOWNLOAD_SLOTS];
} controller;

static int give_room(rtid_room *room, unsigned n_nodes, unsigned n_counts)
{
    room->nodes = malloc(n_nodes * sizeof *room->nodes);
    room->counts = malloc(n_counts * sizeof *room->counts);
    room->status = malloc(n_counts);
    room->n_nodes = (uint16_t)n_nodes;
    room->n_counts = (uint16_t)n_counts;
    return room->nodes && room->counts && room->status;
}

controller *controller_new(unsigned n_slots, unsigned n_nodes, unsigned n_counts)
{
    controller *c = calloc(1, sizeof *c);
    if (c == NULL)
        abort();
    c->d.slots = c->slots;
    c->d.n_slots = (uint8_t)n_slots;
    for (unsigned k = 0; k < n_slots; k++)
        for (int side = 0; side < 2; side++)
            if (!give_room(&c->slots[k].room[side], n_nodes, n_counts))
                abort();
    return c;
}

void controller_free(controller *c)
{
    for (unsigned k = 0; k < c->d.n_slots; k++)
        for (int side = 0; side < 2; side++) {
            free(c->slots[k].room[side].nodes);
            free(c->slots[k].room[side].counts);
            free(c->slots[k].room[side].status);
        }
    free(c);
}

int controller_push(controller *c, uint32_t now_ms, const uint8_t *data, uint8_t length,
                    uint8_t *answers)
{
    return rtid_download_push(&c->d, now_ms, data, length, (uint8_t(*)[8])answers);
}

void controller_limit(controller *c, float command, float dp, float flow)
{
    c->d.max_command = command;
    c->d.max_dp = dp;
    c->d.max_flow = flow;
}

void controller_hold(controller *c, int hold) { c->d.hold = (uint8_t)hold; }

int controller_held(const controller *c, unsigned k, uint32_t *version, uint32_t *crc)
{
    const unsigned side = (unsigned)c->d.side >> k & 1u;
    *version = c->slots[k].version[side];
    *crc = c->slots[k].crc[side];
    return (int)((unsigned)c->d.present >> k & 1u);
}

void controller_flow(const controller *c, unsigned k, size_t n, const float *u, const float *dp,
                     float *q, uint8_t *status)
{
    const rtid_map *map = rtid_download_map(&c->d, k);
    for (size_t i = 0; i < n; i++)
        status[i] = (uint8_t)rtid_map_flow(map, u[i], dp[i], &q[i]);
}

void controller_command(const controller *c, unsigned k, size_t n, const float *q,
                        const float *dp, float *u, uint8_t *status)
{
    const rtid_map *map = rtid_download_map(&c->d, k);
    for (size_t i = 0; i < n; i++)
        status[i] = (uint8_t)rtid_map_command(map, q[i], dp[i], &u[i]);
}

unsigned controller_numbers(const controller *c, unsigned k, float *out)
{
    unsigned count;
    const float *numbers = rtid_download_numbers(&c->d, k, &count);
    for (unsigned i = 0; i < count; i++)
        out[i] = numbers[i];
    return count;
}

void controller_counts(const controller *c, uint32_t *out)
{
    out[0] = c->d.damaged;
    out[1] = c->d.strange;
    out[2] = c->d.repeated;
}

/* learning, verdict, alarms, progress, valid, flags, counter, chamber, beta and sd in Pa */
int controller_notice(const uint8_t *data, uint8_t length, float *out)
{
    rtid_notice notice;
    int op;
    memset(&notice, 0, sizeof notice);
    op = rtid_notice_read(data, length, &notice);
    out[0] = notice.learning;
    out[1] = notice.verdict;
    out[2] = notice.alarms;
    out[3] = notice.progress;
    out[4] = notice.valid;
    out[5] = notice.flags;
    out[6] = notice.counter;
    out[7] = notice.chamber;
    out[8] = notice.beta;
    out[9] = notice.beta_sd;
    return op;
}

#ifdef PROGRAM
/* After the frames: which maps are held, and a look at each of them. */
int main(void)
{
    controller *c = controller_new(4, 64, 400);
    uint8_t frame[9], answers[RTID_DOWNLOAD_ANSWERS * 8];
    uint32_t now_ms = 0;
    while (fread(frame, 1, sizeof frame, stdin) == sizeof frame) {
        const int n = controller_push(c, now_ms++, frame + 1, frame[0], answers);
        fwrite(answers, 8, (size_t)n, stdout);
    }
    for (unsigned k = 0; k < 4; k++) {
        uint32_t version, crc;
        float q = 0.0f, u = 0.0f, numbers[64];
        const int held = controller_held(c, k, &version, &crc);
        const rtid_map *map = rtid_download_map(&c->d, k);
        for (float x = -12.0f; x < 12.0f; x += 0.37f) {
            rtid_map_flow(map, x, x * 1e6f, &q);
            rtid_map_command(map, x * 1e-4f, x * 1e6f, &u);
        }
        controller_numbers(c, k, numbers);
        printf("%d %u %u\n", held, held ? (unsigned)version : 0u, held ? (unsigned)crc : 0u);
    }
    controller_free(c);
    return 0;
}
#endif
