/* What must outlive a loss of power: two banks, written in turn, each with its number and CRC-32.
 * A bank that was being written when the power went does not match; the other one stands. */
#ifndef STORE_H
#define STORE_H

#include <stddef.h>
#include <stdint.h>

/* The newest whole bank of this build into bytes; its number, 0 if there is none. */
uint32_t store_read(void *bytes, size_t n, const char *build);

/* Write the next bank. */
void store_write(const void *bytes, size_t n, const char *build);

#endif
