/* CRC-8 SAE J1850, one byte at a time: of the controller's frames and of the map download. */
#ifndef RTID_CRC8_H
#define RTID_CRC8_H

#include <stdint.h>

static uint8_t crc8_step(uint8_t crc, uint8_t byte)
{
    uint32_t now = (uint32_t)crc ^ byte;
    for (int bit = 0; bit < 8; bit++) {
        now = ((now & 0x80u) != 0u) ? (((now << 1) ^ 0x1Du) & 0xFFu) : (now << 1);
    }
    return (uint8_t)now;
}

#endif
