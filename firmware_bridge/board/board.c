/* Start-up of a Cortex-M with its floating-point unit on; semihosting calls. */
#include "board.h"

#include <string.h>

enum { SYS_OPEN = 0x01, SYS_CLOSE = 0x02, SYS_WRITE = 0x05, SYS_READ = 0x06, SYS_EXIT_EXTENDED = 0x20 };
enum { APPLICATION_EXIT = 0x20026 };

extern uint32_t stack_end, data_load, data_start, data_end, bss_start, bss_end;
int main(void);
void reset(void);

static uint32_t host(uint32_t call, const void *words)
{
    register uint32_t r0 __asm__("r0") = call;
    register const void *r1 __asm__("r1") = words;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

int board_open(const char *name, int mode)
{
    const uint32_t words[] = {(uint32_t)name, (uint32_t)mode, strlen(name)};
    return (int)host(SYS_OPEN, words);
}

size_t board_read(int file, void *bytes, size_t n)
{
    const uint32_t words[] = {(uint32_t)file, (uint32_t)bytes, n};
    return n - host(SYS_READ, words);
}

void board_write(int file, const void *bytes, size_t n)
{
    const uint32_t words[] = {(uint32_t)file, (uint32_t)bytes, n};
    (void)host(SYS_WRITE, words);
}

void board_close(int file)
{
    const uint32_t words[] = {(uint32_t)file};
    (void)host(SYS_CLOSE, words);
}

void board_exit(int code)
{
    const uint32_t words[] = {APPLICATION_EXIT, (uint32_t)code};
    (void)host(SYS_EXIT_EXTENDED, words);
    for (;;) {
    }
}

void board_count(void)
{
    volatile uint32_t *systick = (volatile uint32_t *)0xE000E010u;
    systick[1] = 0xFFFFFFu;
    systick[2] = 0;
    systick[0] = 5; /* on, from the processor's clock */
}

void board_every_ms(void)
{
    volatile uint32_t *systick = (volatile uint32_t *)0xE000E010u;
    systick[1] = BOARD_MS;
    systick[2] = 0;
    systick[0] = 7; /* and an interrupt at zero */
}

__attribute__((weak)) void board_tick(void) {} /* for programs that have none */

static void fault(void) { board_exit(99); }

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* floating-point unit */
    __asm__ volatile("dsb\n isb");
    memcpy(&data_start, &data_load, (size_t)((char *)&data_end - (char *)&data_start));
    memset(&bss_start, 0, (size_t)((char *)&bss_end - (char *)&bss_start));
    board_count();
    board_exit(main());
}

__attribute__((section(".vectors"), used)) static const void *const VECTORS[16] = {
    &stack_end,          (void *)(uintptr_t)reset, (void *)(uintptr_t)fault, (void *)(uintptr_t)fault,
    (void *)(uintptr_t)fault, (void *)(uintptr_t)fault, (void *)(uintptr_t)fault,
    [15] = (void *)(uintptr_t)board_tick,
};
