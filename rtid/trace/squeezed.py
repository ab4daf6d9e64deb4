"""Bytes without their words of zeros: half of the sums are of blocks that were never visited.

What is no zero is of random digits, so that nothing else makes it smaller; this takes a tenth of
the time of deflating, which on a busy computer decides how old a snapshot is.  Of each word of 8
bytes there is a bit that says whether it is a zero; behind all bits stand the words that are none.
"""

from __future__ import annotations

import struct

import numpy as np

HEAD = struct.Struct("<8sQ")  # mark, bytes of the content
MARK = b"RTIDZERO"
WORD = 8


def squeezed(content: bytes) -> bytes:
    """Mark, length, which words are no zero, and those."""
    words = np.frombuffer(content + bytes(-len(content) % WORD), np.uint64)
    is_used = words != 0
    head = HEAD.pack(MARK, len(content))
    return head + np.packbits(is_used).tobytes() + words[is_used].tobytes()


def unsqueezed(content: bytes) -> bytes:
    """What `squeezed` was given; other bytes as they are.  ValueError where a part is missing."""
    if not content.startswith(MARK):
        return content
    size = HEAD.unpack_from(content)[1]
    n = -(-size // WORD)
    begin = HEAD.size + -(-n // 8)
    if begin > len(content):
        raise ValueError("cut off")
    bits = np.frombuffer(content[HEAD.size : begin], np.uint8)
    is_used = np.unpackbits(bits, count=n).astype(bool)
    words = np.zeros(n, np.uint64)
    words[is_used] = np.frombuffer(content[begin:], np.uint64)
    return words.tobytes()[:size]
