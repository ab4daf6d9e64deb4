"""Signals in an 8 byte payload: bulk decoder and encoder from the bit layout.

The payload is one 64 bit word: little-endian for Intel signals, byte-swapped for Motorola ones;
in either the signal is raw = (word >> shift) & (2^length - 1), value = raw * scale + offset.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.jit import Integer, Record, Records, inlined, kernel

UNSIGNED, SIGNED, FLOAT32, FLOAT64 = 0, 1, 2, 3

LAYOUT = np.dtype(
    [
        ("shift", np.uint8),
        ("length", np.uint8),
        ("big_endian", np.bool_),
        ("kind", np.uint8),  # UNSIGNED, SIGNED, FLOAT32 or FLOAT64
        ("scale", np.float64),
        ("offset", np.float64),
        ("minimum", np.float64),  # a value outside is not available
        ("maximum", np.float64),
        ("selector", np.int16),  # row of the multiplexer signal that must select this one, or -1
        ("pages_first", np.int32),  # its pages: codes[pages_first : pages_first + pages_count]
        ("pages_count", np.int32),
        ("absent_first", np.int32),  # raw values that mean "not available", in codes as well
        ("absent_count", np.int32),
    ]
)


@inlined
def swap_bytes(word: np.uint64) -> np.uint64:
    """The same 8 bytes in the other order."""
    low = np.uint64(0x00FF00FF00FF00FF)
    half = np.uint64(0x0000FFFF0000FFFF)
    word = ((word >> np.uint64(8)) & low) | ((word & low) << np.uint64(8))
    word = ((word >> np.uint64(16)) & half) | ((word & half) << np.uint64(16))
    return (word >> np.uint64(32)) | (word << np.uint64(32))


@inlined
def raw_bits(word: np.uint64, row: Record) -> np.uint64:
    """The bits of one signal, right-aligned."""
    if row.big_endian:
        word = swap_bytes(word)
    mask = np.uint64(0xFFFFFFFFFFFFFFFF) >> np.uint64(64 - row.length)
    return (word >> np.uint64(row.shift)) & mask


@inlined
def raw_number(bits: np.uint64, row: Record) -> float:
    """The bits as a number, before scaling."""
    if row.kind == UNSIGNED:
        return np.float64(bits)
    if row.kind == FLOAT64:
        return np.uint64(bits).view(np.float64)
    if row.kind == FLOAT32:
        return np.float64(np.uint32(bits).view(np.float32))
    shift = np.int64(64 - row.length)
    return np.float64(np.int64(bits << np.uint64(shift)) >> shift)


@inlined
def contains(codes: NDArray[np.uint64], first: Integer, count: Integer, bits: np.uint64) -> bool:
    """Whether `bits` is one of codes[first : first + count]; codes (codes,)."""
    for k in range(first, first + count):  # noqa: SIM110  numba has no generators
        if codes[k] == bits:
            return True
    return False


@inlined
def selected(word: np.uint64, layouts: Records, k: Integer, codes: NDArray[np.uint64]) -> bool:
    """Whether all multiplexers above signal k, of layouts (signals,), select it in this payload."""
    while layouts[k].selector >= 0:
        above = layouts[k].selector
        page = raw_bits(word, layouts[above])
        if not contains(codes, layouts[k].pages_first, layouts[k].pages_count, page):
            return False
        k = above
    return True


@inlined
def decode_one(word: np.uint64, layouts: Records, k: Integer, codes: NDArray[np.uint64]) -> float:
    """Value of signal k of layouts (signals,), DBC units; NaN if not available or out of range."""
    row = layouts[k]
    bits = raw_bits(word, row)
    if row.absent_count and contains(codes, row.absent_first, row.absent_count, bits):
        return np.nan
    value = raw_number(bits, row) * row.scale + row.offset
    return value if row.minimum <= value <= row.maximum else np.nan


@inlined
def _decode_integers(words: NDArray[np.uint64], row: Record, out: NDArray[np.float64]) -> None:
    """`decode_one` of a plain integer signal for all words, free of branches; out (n,) changed."""
    shift, big_endian = np.uint64(row.shift), row.big_endian
    mask = np.uint64(0xFFFFFFFFFFFFFFFF) >> np.uint64(64 - row.length)
    sign = np.uint64(1) << np.uint64(row.length - 1) if row.kind == SIGNED else np.uint64(0)
    scale, offset, minimum, maximum = row.scale, row.offset, row.minimum, row.maximum
    for i in range(len(words)):
        word = swap_bytes(words[i]) if big_endian else words[i]
        raw = np.int64((((word >> shift) & mask) ^ sign) - sign)
        value = raw * scale + offset
        out[i] = value if minimum <= value <= maximum else np.nan


@kernel
def decode_words(
    words: NDArray[np.uint64], layouts: Records, n_signals: Integer, codes: NDArray[np.uint64]
) -> NDArray[np.float64]:
    """Values float64 (n_signals, n), DBC units, of n payloads; NaN where absent or not selected."""
    out = np.empty((n_signals, len(words)))
    for k in range(n_signals):
        row = layouts[k]
        plain = row.selector < 0 and row.absent_count == 0
        if plain and (row.kind == SIGNED or (row.kind == UNSIGNED and row.length < 64)):
            _decode_integers(words, row, out[k])
            continue
        for i in range(len(words)):
            known = selected(words[i], layouts, k, codes)
            out[k, i] = decode_one(words[i], layouts, k, codes) if known else np.nan
    return out


@inlined
def to_bits(value: float, row: Record) -> np.uint64:
    """Raw bits of a physical value: saturating; NaN becomes the code for not available."""
    ones = np.uint64(0xFFFFFFFFFFFFFFFF) >> np.uint64(64 - row.length)
    if row.kind == FLOAT64:
        return np.float64((value - row.offset) / row.scale).view(np.uint64)
    if row.kind == FLOAT32:
        return np.uint64(np.float32((value - row.offset) / row.scale).view(np.uint32))
    top = np.uint64(1) << np.uint64(row.length - 1)
    if np.isnan(value):
        return ones if row.kind == UNSIGNED else top
    low, high = (row.minimum - row.offset) / row.scale, (row.maximum - row.offset) / row.scale
    raw = np.rint((value - row.offset) / row.scale)
    raw = min(max(raw, np.ceil(min(low, high))), np.floor(max(low, high)))
    if row.kind == UNSIGNED:
        return ones if raw >= np.float64(ones) else np.uint64(max(raw, 0.0))
    if raw >= np.float64(top):
        return top - np.uint64(1)
    return np.uint64(np.int64(max(raw, -np.float64(top)))) & ones


@kernel
def encode_words(values: NDArray[np.float64], layouts: Records, words: NDArray[np.uint64]) -> None:
    """Put values float64 (n, m) of the first m layouts into words uint64 (n,), changed in place."""
    for k in range(values.shape[1]):
        row = layouts[k]
        for i in range(len(words)):
            bits = to_bits(values[i, k], row) << np.uint64(row.shift)
            words[i] |= swap_bytes(bits) if row.big_endian else bits
