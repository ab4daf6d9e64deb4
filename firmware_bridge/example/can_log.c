#include "can_log.h"

#include <string.h>

#include "board.h"

static char text[4096];
static size_t filled, at;
static int file;

static int next_char(void)
{
    if (at == filled) {
        filled = board_read(file, text, sizeof text);
        at = 0;
    }
    return at < filled ? (int)text[at++] : -1;
}

/* Digits up to the first character that is none, which is taken too. */
static uint64_t number(unsigned base)
{
    uint64_t value = 0;
    for (;;) {
        const int c = next_char();
        const int digit = c >= '0' && c <= '9' ? c - '0' : c >= 'A' && c <= 'F' ? c - 'A' + 10 : 99;
        if (digit >= (int)base)
            return value;
        value = value * base + (unsigned)digit;
    }
}

static int skip_to(int wanted)
{
    int c = next_char();
    while (c >= 0 && c != wanted)
        c = next_char();
    return c;
}

/* (1600000000.000123) can0 121#0011223344556677 */
static int read_line(rtid_frame *frame)
{
    uint64_t data;
    if (skip_to('(') < 0)
        return 0;
    memset(frame, 0, sizeof *frame);
    frame->t_us = (int64_t)number(10) * 1000000;
    frame->t_us += (int64_t)number(10);
    (void)skip_to(' ');
    (void)skip_to(' ');
    frame->can_id = (uint32_t)number(16);
    frame->length = 8; /* as all messages of the controller and of the download */
    data = number(16);
    for (int k = 7; k >= 0; k--, data >>= 8)
        frame->data[k] = (uint8_t)data;
    return 1;
}

size_t can_log_read(const char *name, rtid_frame *frames, size_t most)
{
    size_t n = 0;
    file = board_open(name, READ);
    while (file >= 0 && n < most && read_line(&frames[n]))
        n++;
    return n;
}
