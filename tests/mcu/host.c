/* The files of firmware_bridge/board on this host. */
#include <fcntl.h>
#include <unistd.h>

#include "board.h"

int board_open(const char *name, int mode)
{
    return open(name, mode == READ ? O_RDONLY : O_WRONLY | O_CREAT | O_TRUNC, 0600);
}

size_t board_read(int file, void *bytes, size_t n)
{
    const ssize_t taken = read(file, bytes, n);
    return taken < 0 ? 0 : (size_t)taken;
}

void board_write(int file, const void *bytes, size_t n)
{
    if (write(file, bytes, n) < 0)
        _exit(1);
}

void board_close(int file) { (void)close(file); }
