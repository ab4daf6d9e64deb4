/* An emulated Cortex-M board: start-up, files of the host by semihosting, a counter. */
#ifndef BOARD_H
#define BOARD_H

#include <stddef.h>
#include <stdint.h>

enum { READ = 1, WRITE = 5 }; /* "rb" and "wb" */

/* A file of the host, by its name; -1 if there is none. */
int board_open(const char *name, int mode);

/* Bytes read, fewer than n at the end of the file. */
size_t board_read(int file, void *bytes, size_t n);
void board_write(int file, const void *bytes, size_t n);
void board_exit(int code);

/* A counter that falls, 24 bits, one per 40 instructions of a board at 25 MHz with -icount shift=0. */
void board_count(void);
static inline uint32_t board_now(void) { return *(volatile uint32_t *)0xE000E018u; }

#endif
