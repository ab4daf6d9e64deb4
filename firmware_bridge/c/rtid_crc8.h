/* CRC-8 SAE J1850, one byte at a time: of the controller's frames and of the map download. */
#ifndef RTID_CRC8_H
#define RTID_CRC8_H

#include <stdint.h>

static uint8_t crc8_step(uint8_t crc, uint8_t byte)
{
    crc ^= byte;
    for (int bit = 0; bit < 8; bit++)
        crc = (uint8_t)(crc & 0x80 ? crc << 1 ^ 0x1D : crc << 1);
    return crc;
}

#endif
