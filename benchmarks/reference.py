"""The hand-written C of the joint estimator on the very records that rtid's kernels use."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from benchmarks.compiler import compile_c, pointer
from rtid.estimator.state import State
from rtid.kernels import layout

FloatArray = NDArray[np.float64]
RECORDS = {"Engine": "ENGINE", "Cell": "CELL", "Block": "BLOCK", "Pair": "PAIR", "Closed": "CLOSED"}


def _header() -> Iterator[str]:
    """Constants and structs of `layout` as C: one source of truth for the records."""
    for name, value in vars(layout).items():
        if name.isupper() and isinstance(value, int):
            yield f"#define {name} {value}"
    for struct, dtype in RECORDS.items():
        yield "typedef struct {"
        yield from _fields(getattr(layout, dtype))
        yield f"}} {struct};"


def _fields(dtype: np.dtype[np.void]) -> Iterator[str]:
    for name in dtype.names or ():
        field = dtype[name]
        c_type = {"f": "double", "i": "int64_t"}[field.base.kind]
        yield f"    {c_type} {name}{''.join(f'[{n}]' for n in field.shape)};"


class Reference:
    """The compiled C, used like `State.advance`."""

    def __init__(self) -> None:
        self._advance = compile_c("reference", "\n".join(_header()) + "\n").advance
        self._advance.restype = ctypes.c_int64

    def advance(self, state: State, chunk: FloatArray) -> None:
        """Take samples (n, 2 + signals) into state, whose tables grow as needed."""
        taken = self._call(state, chunk)
        while taken < len(chunk):
            state.make_room()
            chunk = chunk[taken:]
            taken = self._call(state, chunk)

    def _call(self, state: State, chunk: FloatArray) -> int:
        size = ctypes.c_int64
        tables = state.closed, state.blocks, state.pairs
        sized = [a for table in tables for a in (pointer(table), size(len(table)))]
        engine, cells = pointer(state.engine), pointer(state.cells)
        return int(self._advance(engine, cells, *sized, pointer(chunk), size(len(chunk))))
