"""Dataclasses, tuples and arrays as sealed bytes, and back: nothing in them is ever executed.

    MARK | keyed digest of all behind it | length of the header | header, JSON | arrays, one by one

The digest is keyed by a secret of the user's own, so that what another one has put there, or what
is damaged, is not even looked at.  Only the classes that the reader names are made.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from rtid.errors import RtidError

MARK = b"RTIDKEPT"
DIGEST = 32
LENGTH = struct.Struct("<Q")
KINDS = "fibU"  # of arrays: numbers and texts, no objects
CLASS, ARRAY, TABLE = "!", "@", "%"  # keys of what JSON has no type for


class PackError(RtidError):
    """The bytes were not written here, or are damaged."""


def packed(value: Any, secret: bytes) -> bytes:
    """A tree of dataclasses, tuples, dicts, arrays, numbers and texts as bytes."""
    arrays: list[bytes] = []
    at = 0

    def plain(value: Any) -> Any:
        nonlocal at
        if is_dataclass(value):
            parts = {f.name: plain(getattr(value, f.name)) for f in fields(value)}
            return {CLASS: type(value).__name__} | parts
        if isinstance(value, np.ndarray):
            content = np.ascontiguousarray(value).tobytes()
            arrays.append(content)
            start, at = at, at + len(content)
            return {ARRAY: [value.dtype.str, list(value.shape), start]}
        if isinstance(value, dict):
            return {TABLE: [[plain(key), plain(entry)] for key, entry in value.items()]}
        if isinstance(value, tuple | list):
            return [plain(entry) for entry in value]
        return value.item() if isinstance(value, np.generic) else value

    header = json.dumps(plain(value)).encode()
    body = b"".join([LENGTH.pack(len(header)), header, *arrays])
    return MARK + _seal(body, secret) + body


def unpacked(content: bytes, secret: bytes, classes: tuple[type, ...]) -> Any:
    """What was packed; lists come back as tuples.  Raises PackError."""
    start = len(MARK) + DIGEST
    body = content[start:]
    if content[: len(MARK)] != MARK or content[len(MARK) : start] != _seal(body, secret):
        raise PackError("not what was written here")
    (length,) = LENGTH.unpack_from(body)
    arrays = memoryview(body)[LENGTH.size + length :]
    known = {kind.__name__: kind for kind in classes}
    try:
        return _made(json.loads(body[LENGTH.size : LENGTH.size + length]), arrays, known)
    except (KeyError, TypeError, ValueError) as error:
        raise PackError(f"of another version ({error})") from error


def _made(value: Any, arrays: memoryview, known: dict[str, type]) -> Any:
    if isinstance(value, list):
        return tuple(_made(entry, arrays, known) for entry in value)
    if not isinstance(value, dict):
        return value
    if ARRAY in value:
        name, shape, start = value[ARRAY]
        dtype = np.dtype(name)
        if dtype.kind not in KINDS:
            raise ValueError(f"an array of {name}")
        count = int(np.prod(shape, dtype=np.int64))
        return np.frombuffer(arrays, dtype, count, start).reshape(shape).copy()
    if TABLE in value:
        return {
            _made(key, arrays, known): _made(entry, arrays, known) for key, entry in value[TABLE]
        }
    parts = {name: _made(part, arrays, known) for name, part in value.items() if name != CLASS}
    return known[value[CLASS]](**parts)


def _seal(body: bytes, secret: bytes) -> bytes:
    return hashlib.blake2b(body, key=secret, digest_size=DIGEST).digest()
