/* Look-up, map download and frames on a board or on the host: the same bytes in, the same out.
 * points.bin: u, dp, q; downloads.bin: frames of eight bytes; frames.bin: rtid_frame. */
#include <string.h>

#include "board.h"
#include "maps.h"
#include "rtid_download.h"
#include "rtid_frames.h"

enum { NODES = 64, COUNTS = 1024 };

static rtid_download download;
static rtid_slot slot;
static float nodes[2][NODES];
static int16_t counts[2][COUNTS];
static uint8_t status[2][COUNTS];
static rtid_receiver receiver;

static void look_up(int out, const rtid_map *map, const rtid_map_fixed *fixed)
{
    const int in = board_open("points.bin", READ);
    float at[3];
    while (board_read(in, at, sizeof at) == sizeof at) {
        float q = 0.0f, u = 0.0f;
        int32_t told[8] = {0};
        told[0] = rtid_map_flow(map, at[0], at[1], &q);
        told[1] = rtid_map_command(map, at[2], at[1], &u);
        memcpy(&told[2], &q, sizeof q);
        memcpy(&told[3], &u, sizeof u);
        told[4] = rtid_map_fixed_flow(fixed, (int32_t)(1e6f * at[0]), (int32_t)at[1], &told[5]);
        told[6] = rtid_map_fixed_command(fixed, (int32_t)(1e9f * at[2]), (int32_t)at[1], &told[7]);
        board_write(out, told, sizeof told);
    }
    board_close(in);
}

static void receive(int out)
{
    const int in = board_open("downloads.bin", READ);
    uint8_t data[8], answer[RTID_DOWNLOAD_ANSWERS][8];
    download.slots = &slot;
    download.n_slots = 1;
    for (int side = 0; side < 2; side++)
        slot.room[side] = (rtid_room){nodes[side], counts[side], status[side], NODES, COUNTS};
    while (board_read(in, data, sizeof data) == sizeof data)
        board_write(out, answer, 8 * (size_t)rtid_download_push(&download, 0, data, 8, answer));
    board_close(in);
}

static void check(int out)
{
    const int in = board_open("frames.bin", READ);
    rtid_frame frame;
    while (board_read(in, &frame, sizeof frame) == sizeof frame) {
        double values[RTID_MAX_VALUES] = {0.0};
        uint8_t wire[RTID_WIRE_MAX] = {0};
        int told[2];
        told[0] = rtid_check(&receiver, &frame, &told[1], values);
        (void)rtid_wire_encode(&frame, wire);
        board_write(out, told, sizeof told);
        board_write(out, values, sizeof values);
        board_write(out, wire, sizeof wire);
    }
    board_close(in);
}

int main(void)
{
    const int out = board_open("out.bin", WRITE);
    look_up(out, &rtid_edge_e1, &rtid_edge_e1_fixed);
    receive(out);
    look_up(out, rtid_download_map(&download, 0), &rtid_edge_e1_fixed);
    check(out);
    board_close(out);
    return 0;
}
