#include "rtid_frames.h"
#include "rtid_crc8.h"
#include "rtid_version.h"

#include <stdbool.h>
#include <string.h>

const char rtid_frames_version[] = "rtid_frames " RTID_C_VERSION;

typedef struct {
    uint32_t can_id;
    uint32_t late_us;
    uint16_t data_id;
    uint8_t first, count; /* rows of SIGNALS */
    uint8_t length;
    uint8_t crc_byte;
    uint8_t counter_shift, counter_bits;
} message_row;

typedef struct {
    uint8_t shift, bits, is_signed;
    int64_t low, high; /* counts outside mean: not available */
    double scale, offset;
} signal_row;

static const message_row MESSAGES[] = {RTID_MESSAGE_ROWS};
static const signal_row SIGNALS[] = {RTID_SIGNAL_ROWS};

static uint64_t mask_of(uint8_t bits) { return (UINT64_C(1) << bits) - 1u; }

static uint64_t word_of(const uint8_t *data)
{
    uint64_t word = 0u;
    for (int k = 7; k >= 0; k--) {
        word = (word << 8) | data[k];
    }
    return word;
}

/* CRC-8 SAE J1850 over the data id and all bytes but the CRC (AUTOSAR E2E Profile 1). */
static uint8_t crc8(const message_row *row, const uint8_t *data)
{
    uint8_t crc = crc8_step(0u, (uint8_t)(row->data_id & 0xFFu));
    crc = crc8_step(crc, (uint8_t)(row->data_id >> 8));
    for (uint8_t k = 0u; k < row->length; k++) {
        if (k != row->crc_byte) {
            crc = crc8_step(crc, data[k]);
        }
    }
    return crc;
}

/* Nearest whole number, halves to even; |x| < 2^52. */
static int64_t nearest(double x)
{
    int64_t n = (int64_t)x;
    double rest = x - (double)n;
    if ((rest > 0.5) || ((rest == 0.5) && ((n % 2) != 0))) {
        n++;
    }
    if ((rest < -0.5) || ((rest == -0.5) && ((n % 2) != 0))) {
        n--;
    }
    return n;
}

static uint64_t to_bits(const signal_row *row, double value)
{
    double x = (value - row->offset) / row->scale;
    int64_t count;
    if (x != x) { /* NaN: the lowest count if signed, else all ones */
        return (row->is_signed != 0u) ? (UINT64_C(1) << (row->bits - 1u)) : mask_of(row->bits);
    }
    if (x <= (double)row->low) {
        count = row->low;
    } else if (x >= (double)row->high) {
        count = row->high;
    } else {
        count = nearest(x);
    }
    return (uint64_t)count & mask_of(row->bits);
}

void rtid_pack(int message, int64_t t_us, uint8_t counter, const double *values,
               rtid_frame *frame)
{
    const message_row *row = &MESSAGES[message];
    uint64_t word = (counter & mask_of(row->counter_bits)) << row->counter_shift;
    for (uint8_t k = 0u; k < row->count; k++) {
        const signal_row *signal = &SIGNALS[row->first + k];
        word |= to_bits(signal, values[k]) << signal->shift;
    }
    frame->t_us = t_us;
    frame->can_id = row->can_id;
    frame->length = row->length;
    for (uint64_t k = 0u; k < 8u; k++) {
        frame->data[k] = (uint8_t)(word >> (8u * k));
    }
    frame->data[row->crc_byte] = crc8(row, frame->data);
}

static int find(uint32_t can_id)
{
    for (int m = 0; m < RTID_N_MESSAGES; m++) {
        if (MESSAGES[m].can_id == can_id) {
            return m;
        }
    }
    return -1;
}

/* A counter cannot see a loss of a multiple of its range: it is judged together with the time. */
static int check_sequence(rtid_receiver *receiver, int m, int64_t t_us, uint8_t counter)
{
    const int64_t dt = t_us - receiver->last[m].t_us, late = (int64_t)MESSAGES[m].late_us;
    const uint32_t mask = (uint32_t)mask_of(MESSAGES[m].counter_bits);
    const uint32_t ahead = ((uint32_t)counter - receiver->last[m].counter) & mask;
    const int step = (int)ahead;
    if (receiver->last[m].seen == 0u) {
        return RTID_OK;
    }
    if ((dt <= late) && (step == 0)) {
        return RTID_COUNTER_REPEAT;
    }
    if ((step > 1) && ((3 * dt) < (step * late))) { /* late, or another sender's */
        return RTID_OUT_OF_ORDER;
    }
    if ((dt > 0) && (step != 1)) {
        receiver->counts[RTID_COUNTER_JUMP]++;
    }
    return (dt <= 0) ? RTID_OUT_OF_ORDER : RTID_OK;
}

static int read_value(const signal_row *row, uint64_t word, double *value)
{
    static const uint64_t nan_bits = UINT64_C(0x7FF8000000000000);
    const uint64_t bits = (word >> row->shift) & mask_of(row->bits);
    int64_t count = (int64_t)bits;
    if ((row->is_signed != 0u) && ((bits >> (row->bits - 1u)) != 0u)) {
        count -= INT64_C(1) << row->bits;
    }
    if ((count < row->low) || (count > row->high)) {
        (void)memcpy(value, &nan_bits, sizeof *value); /* MISRA 21.15: the bits of NaN */
        return RTID_NOT_AVAILABLE;
    }
    *value = ((double)count * row->scale) + row->offset;
    return RTID_OK;
}

static int judge(rtid_receiver *receiver, const rtid_frame *frame, int m, double *values)
{
    const message_row *row = &MESSAGES[m];
    const uint64_t word = word_of(frame->data);
    const uint8_t counter = (uint8_t)((word >> row->counter_shift) & mask_of(row->counter_bits));
    int verdict;
    if (frame->length != row->length) {
        return RTID_WRONG_LENGTH;
    }
    if (crc8(row, frame->data) != frame->data[row->crc_byte]) {
        return RTID_CRC;
    }
    verdict = check_sequence(receiver, m, frame->t_us, counter);
    if (verdict != RTID_OK) {
        return verdict;
    }
    receiver->last[m].t_us = frame->t_us;
    receiver->last[m].counter = counter;
    receiver->last[m].seen = 1u;
    for (uint8_t k = 0u; k < row->count; k++) {
        if (read_value(&SIGNALS[row->first + k], word, &values[k]) != RTID_OK) {
            verdict = RTID_NOT_AVAILABLE;
        }
    }
    return verdict;
}

int rtid_check(rtid_receiver *receiver, const rtid_frame *frame, int *message, double *values)
{
    const int m = find(frame->can_id);
    const int verdict = (m < 0) ? RTID_UNKNOWN_ID : judge(receiver, frame, m, values);
    if (verdict != RTID_OK) {
        receiver->counts[verdict]++;
    }
    *message = m;
    return verdict;
}

/* CRC-16 CCITT, start 0xFFFF, inverted at the end: a plain one that ends in 0x00 could lose it. */
static uint16_t crc16(const uint8_t *data, size_t n)
{
    uint32_t crc = 0xFFFFu;
    for (size_t k = 0u; k < n; k++) {
        crc ^= (uint32_t)data[k] << 8;
        for (int bit = 0; bit < 8; bit++) {
            crc = ((crc & 0x8000u) != 0u) ? (((crc << 1) ^ 0x1021u) & 0xFFFFu) : (crc << 1);
        }
    }
    return (uint16_t)(crc ^ 0xFFFFu);
}

size_t rtid_wire_encode(const rtid_frame *frame, uint8_t *out)
{
    uint8_t block[RTID_BLOCK_MAX];
    const size_t length = (frame->length > 8u) ? 8u : (size_t)frame->length;
    size_t n = 12u + length, code = 1u, k;
    uint16_t crc;
    for (k = 0u; k < 4u; k++) {
        block[k] = (uint8_t)(frame->can_id >> (8u * k));
    }
    for (k = 0u; k < 8u; k++) {
        block[4u + k] = (uint8_t)((uint64_t)frame->t_us >> (8u * k));
    }
    (void)memcpy(&block[12], frame->data, length);
    crc = crc16(block, n);
    block[n] = (uint8_t)(crc >> 8);
    block[n + 1u] = (uint8_t)(crc & 0xFFu);
    n += 2u;

    out[0] = 0u;
    out[code] = 1u;
    for (k = 0u; k < n; k++) { /* COBS: out[code] counts the way to the next zero */
        if (block[k] == 0u) {
            code += out[code];
            out[code] = 1u;
        } else {
            out[code + out[code]] = block[k];
            out[code]++;
        }
    }
    code += out[code];
    out[code] = 0u;
    return code + 1u;
}

/* Undo COBS into block[RTID_BLOCK_MAX]; the number of bytes, 0 if malformed. */
static size_t uncobs(const uint8_t *code, size_t end, uint8_t *block)
{
    size_t n = 0u, pos = 0u;
    while (pos < end) {
        const size_t run = code[pos];
        if ((pos + run) > end) {
            return 0u;
        }
        (void)memcpy(&block[n], &code[pos + 1u], run - 1u);
        n += run - 1u;
        pos += run;
        if (pos < end) {
            block[n] = 0u;
            n++;
        }
    }
    return n;
}

static bool unpack(const uint8_t *block, size_t n, rtid_frame *frame)
{
    const size_t length = n - 14u;
    uint64_t t_us = 0u;
    uint32_t can_id = 0u, most;
    if ((n < 14u) || (n > RTID_BLOCK_MAX)) {
        return false;
    }
    if (crc16(block, n - 2u) != (uint16_t)(((uint32_t)block[n - 2u] << 8) | block[n - 1u])) {
        return false;
    }
    for (int k = 3; k >= 0; k--) {
        can_id = (can_id << 8) | block[k];
    }
    for (int k = 11; k >= 4; k--) {
        t_us = (t_us << 8) | block[k];
    }
    most = ((can_id & RTID_EXTENDED) != 0u) ? 0x20000000u : 0x800u; /* 29 and 11 bits */
    if (((t_us >> 53) != 0u) || ((can_id & ~RTID_EXTENDED) >= most)) {
        return false;
    }
    frame->t_us = (int64_t)t_us;
    frame->can_id = can_id;
    frame->length = (uint8_t)length;
    (void)memset(frame->data, 0, sizeof frame->data);
    (void)memcpy(frame->data, &block[12], length);
    return true;
}

int rtid_wire_push(rtid_decoder *decoder, uint8_t byte, rtid_frame *frame)
{
    uint8_t block[RTID_CODE_MAX];
    const size_t n = decoder->n;
    bool good;
    if (byte != 0u) {
        if (n < RTID_CODE_MAX) {
            decoder->code[n] = byte;
        }
        if (n <= RTID_CODE_MAX) {
            decoder->n++;
        }
        return 0;
    }
    decoder->n = 0u;
    if (n == 0u) {
        return 0;
    }
    good = (n <= RTID_CODE_MAX) && unpack(block, uncobs(decoder->code, n, block), frame);
    if (!good) {
        decoder->bad++;
    }
    return good ? 1 : 0;
}
