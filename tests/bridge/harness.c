/* Runs firmware_bridge/c on records from stdin, for test_c_bridge.py: one mode per call. */
#include <stdio.h>
#include <string.h>

#include "rtid_frames.h"

typedef struct {
    int64_t t_us;
    int32_t message;
    uint32_t counter;
    double values[RTID_MAX_VALUES];
} order;

typedef struct {
    int32_t verdict, message;
    double values[RTID_MAX_VALUES];
} result;

static void put(const void *record, size_t size) { fwrite(record, size, 1, stdout); }

static void pack(void)
{
    order in;
    rtid_frame out;
    memset(&out, 0, sizeof out);
    while (fread(&in, sizeof in, 1, stdin) == 1) {
        rtid_pack(in.message, in.t_us, (uint8_t)in.counter, in.values, &out);
        put(&out, sizeof out);
    }
}

static void check(void)
{
    static rtid_receiver receiver;
    rtid_frame in;
    while (fread(&in, sizeof in, 1, stdin) == 1) {
        result out;
        int message;
        memset(&out, 0, sizeof out);
        out.verdict = rtid_check(&receiver, &in, &message, out.values);
        out.message = message;
        put(&out, sizeof out);
    }
    put(receiver.counts, sizeof receiver.counts);
}

static void encode(void)
{
    rtid_frame in;
    uint8_t out[RTID_WIRE_MAX];
    while (fread(&in, sizeof in, 1, stdin) == 1)
        put(out, rtid_wire_encode(&in, out));
}

static void decode(void)
{
    static rtid_decoder decoder;
    rtid_frame out;
    int byte;
    memset(&out, 0, sizeof out);
    while ((byte = getchar()) != EOF)
        if (rtid_wire_push(&decoder, (uint8_t)byte, &out))
            put(&out, sizeof out);
    put(&decoder.bad, sizeof decoder.bad);
}

int main(int count, char **arguments)
{
    const char *mode = count == 2 ? arguments[1] : "";
    if (strcmp(mode, "pack") == 0)
        pack();
    else if (strcmp(mode, "check") == 0)
        check();
    else if (strcmp(mode, "encode") == 0)
        encode();
    else if (strcmp(mode, "decode") == 0)
        decode();
    else
        return 2;
    return 0;
}
