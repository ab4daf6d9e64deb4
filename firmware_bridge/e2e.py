"""End-to-end protection: CRC-8 SAE J1850, polynomial x^8 + x^4 + x^3 + x^2 + 1 (0x1D).

As in AUTOSAR E2E Profile 1 the checksum runs over the data id (low byte, high byte) and over all
payload bytes but its own, with start and XOR value 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.jit import Integer, inlined, kernel

POLYNOMIAL = 0x1D


def _table() -> NDArray[np.uint8]:
    table = np.arange(256)
    for _ in range(8):
        table = (table << 1) ^ POLYNOMIAL * (table >> 7)
        table &= 0xFF
    return table.astype(np.uint8)


TABLE = _table()


@inlined
def crc8(word: np.uint64, length: Integer, crc_byte: Integer, data_id: Integer) -> Integer:
    """CRC of one payload (bytes as a little-endian word), leaving out byte `crc_byte`."""
    crc = TABLE[data_id & 0xFF]
    crc = TABLE[crc ^ np.uint8((data_id >> 8) & 0xFF)]
    for k in range(length):
        if k != crc_byte:
            crc = TABLE[crc ^ np.uint8((word >> np.uint64(8 * k)) & np.uint64(0xFF))]
    return int(crc)


@kernel
def crc8_bulk(
    data: NDArray[np.uint8], length: Integer, crc_byte: Integer, data_id: Integer
) -> NDArray[np.uint8]:
    """CRCs of n payloads uint8 (n, 8) of the same message; uint8 (n,)."""
    out = np.empty(data.shape[0], np.uint8)
    for i in range(data.shape[0]):
        word = np.uint64(0)
        for k in range(8):
            word |= np.uint64(data[i, k]) << np.uint64(8 * k)
        out[i] = crc8(word, length, crc_byte, data_id)
    return out
