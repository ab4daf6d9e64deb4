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
void board_close(int file);
void board_exit(int code);

/* A counter that falls, 24 bits, one per 40 instructions of a board at 25 MHz with -icount shift=0. */
void board_count(void);
static inline uint32_t board_now(void) { return *(volatile uint32_t *)0xE000E018u; }

/* The same counter from BOARD_MS down to 0 in a millisecond; board_tick is called at its end. */
#define BOARD_MS 24999u
void board_every_ms(void);
void board_tick(void);

/* No interrupt in between: a tick that is due waits. */
static inline void board_lock(void) { __asm__ volatile("cpsid i" ::: "memory"); }
static inline void board_wait(void) { __asm__ volatile("wfi" ::: "memory"); }
static inline void board_unlock(void) { __asm__ volatile("cpsie i" ::: "memory"); }

#endif
