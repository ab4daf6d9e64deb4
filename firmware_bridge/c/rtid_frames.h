/* Frames of the controller for its firmware: packed, checked, and over a serial line.
 *
 * C99, no heap, nothing but stdint.h, stddef.h and string.h, no state but what the caller hands in.
 * Byte for byte what firmware_bridge packs and admits in Python (tests/bridge/test_c_bridge.py);
 * the tables of rtid_tables.h are generated from the DBC.  Compile without -ffast-math: NaN means
 * "not available".
 *
 * Sending over CAN:     rtid_pack, then hand frame.can_id, length and data to the CAN driver.
 * Sending over a UART:  rtid_pack, rtid_wire_encode, then write the bytes.
 * Receiving:            rtid_wire_push byte by byte, or a frame from the CAN driver; rtid_check.
 */
#ifndef RTID_FRAMES_H
#define RTID_FRAMES_H

#include <stddef.h>
#include <stdint.h>

#include "rtid_tables.h"

#define RTID_EXTENDED 0x80000000u /* bit 31 of can_id: 29 bit identifier */
#define RTID_BLOCK_MAX 22u         /* can_id, t_us, 8 bytes of payload, CRC-16 */
#define RTID_CODE_MAX (RTID_BLOCK_MAX + 1u)
#define RTID_WIRE_MAX (RTID_CODE_MAX + 2u)

typedef struct {
    int64_t t_us; /* clock of the controller, 0 to 2^53 - 1 */
    uint32_t can_id;
    uint8_t length;
    uint8_t data[8]; /* zero behind the payload */
} rtid_frame;

/* Verdicts; the same numbers as in firmware_bridge.checks. */
enum {
    RTID_OK = -1,
    RTID_UNKNOWN_ID = 0,
    RTID_WRONG_LENGTH = 1,
    RTID_CRC = 2,
    RTID_COUNTER_REPEAT = 3,
    RTID_COUNTER_JUMP = 4, /* counted, never returned: the frame itself is good */
    RTID_OUT_OF_ORDER = 5,
    RTID_NOT_AVAILABLE = 6,
    RTID_N_REASONS = 7
};

/* What a receiver remembers; all zero at the start. */
typedef struct {
    struct {
        int64_t t_us;
        uint8_t counter;
        uint8_t seen;
    } last[RTID_N_MESSAGES];
    uint32_t counts[RTID_N_REASONS];
} rtid_receiver;

/* A serial line being read; all zero at the start. */
typedef struct {
    uint8_t code[RTID_CODE_MAX];
    uint8_t n;    /* bytes in code; RTID_CODE_MAX + 1: too many */
    uint32_t bad; /* damaged frames */
} rtid_decoder;

/* Pack one message: values in the units of the DBC, in the order of rtid_tables.h; they saturate,
 * NaN is sent as "not available".  message: RTID_VALVE_COMMAND, ...; counter: taken modulo its
 * range. */
void rtid_pack(int message, int64_t t_us, uint8_t counter, const double *values,
               rtid_frame *frame);

/* Judge one frame and read its values (RTID_MAX_VALUES); RTID_OK or the reason against it, which is
 * counted.  Values that are not available are NaN.  message: which one it is, -1 for none. */
int rtid_check(rtid_receiver *receiver, const rtid_frame *frame, int *message, double *values);

/* The bytes that send a frame, into out[RTID_WIRE_MAX]; their number. */
size_t rtid_wire_encode(const rtid_frame *frame, uint8_t *out);

/* Take one received byte; 1 if it completed a frame, else 0. */
int rtid_wire_push(rtid_decoder *decoder, uint8_t byte, rtid_frame *frame);

extern const char rtid_frames_version[];

#endif
