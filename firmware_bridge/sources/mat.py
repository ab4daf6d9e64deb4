"""MATLAB .mat files up to version 7: their vectors, after a look at what they unpack to.

A file tells the shapes of its variables, and how many bytes follow: the two need not agree.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.sources.unpacked import Budget

HEAD_BYTES, NUMBER_BYTES, STEP_BYTES = 128, 8, 1 << 20
COMPRESSED = 15  # type of an element
NO_NUMBERS = ("cell", "struct", "object", "char", "sparse", "function", "opaque", "unknown")


class Variable(NamedTuple):
    """What a file says about one of its variables."""

    name: str
    shape: tuple[int, ...]
    kind: str

    @property
    def is_vector(self) -> bool:
        """Whether exactly one of its sides is longer than 1, and it holds numbers."""
        return sum(n != 1 for n in self.shape) == 1 and self.kind not in NO_NUMBERS

    @property
    def is_read(self) -> bool:
        """Whether it may hold vectors: is one, or a struct of them."""
        return self.is_vector or (self.kind == "struct" and math.prod(self.shape) == 1)


def vectors(path: Path) -> tuple[dict[str, NDArray[np.float64]], dict[str, str]]:
    """Every vector (n,) of real numbers, float64, in the file's units; and what else there is.

    The fields of a struct have their own names, of several structs with its name before.

    Raises LogError if they unpack to too much, what scipy raises for a damaged file,
    NotImplementedError for one of MATLAB 7.3.
    """
    from scipy.io import loadmat, whosmat  # noqa: PLC0415  only this format needs them
    from scipy.io.matlab import matfile_version  # noqa: PLC0415

    listed = [Variable(*fields) for fields in whosmat(path)]
    wanted = [variable for variable in listed if variable.is_read]
    Budget(path).take(NUMBER_BYTES * sum(math.prod(variable.shape) for variable in wanted))
    if matfile_version(path)[0] == 1:
        _check_elements(path, listed)
    content: dict[str, Any] = loadmat(
        path, squeeze_me=True, variable_names=[variable.name for variable in wanted]
    )
    inside = {v.name: _fields(content.pop(v.name)) for v in wanted if v.kind == "struct"}
    found = _numbers(content)
    for struct_name, fields in inside.items():
        for name, values in _numbers(fields).items():
            is_taken = len(inside) > 1 or name in found
            found[f"{struct_name}.{name}" if is_taken else name] = values
    few = {name for name, fields in inside.items() if len(_numbers(fields)) < 2}
    unread = {
        v.name: f"a {v.kind} of {' x '.join(map(str, v.shape))}"
        for v in listed
        if v.name in few or (not v.is_read and math.prod(v.shape) > 1)
    }
    return found, unread


def _fields(struct: Any) -> dict[str, Any]:
    """What a struct holds, by name."""
    return {name: struct[name].item() for name in struct.dtype.names or ()}


def _numbers(content: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    """The vectors (n,) of real numbers among them."""
    return {
        name: np.asarray(value, np.float64)
        for name, value in content.items()
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "iufb"
    }


def _check_elements(path: Path, listed: list[Variable]) -> None:
    """LogError if the elements of the vectors inflate to too much, whatever their shapes say."""
    budget = Budget(path)
    with path.open("rb") as file:
        order = "<" if file.read(HEAD_BYTES)[-2:] == b"IM" else ">"
        for variable in listed:
            kind, size = struct.unpack(order + "II", file.read(8))
            if kind != COMPRESSED or not variable.is_read:
                file.seek(size, 1)
                continue
            engine, packed = zlib.decompressobj(), file.read(size)
            while packed and not engine.eof:
                budget.take(len(engine.decompress(packed, STEP_BYTES)))
                packed = engine.unconsumed_tail
