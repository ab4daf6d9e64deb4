"""What the tests of a module share: the same trace with the same project is learned once.

A replay, a diagnosis and a map are functions of what they are given, bit for bit, and what follows
only reads them; so each command of a module need not begin anew.
"""

from __future__ import annotations

import functools
import hashlib
import io
import pickle
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any

import pytest

from rtid.diagnose.diagnosis import search, searched
from rtid.diagnose.report import diagnosis
from rtid.diagnose.standing import fitted
from rtid.estimator.published import publish

SHARED: tuple[Callable[..., Any], ...] = (fitted, search, searched, diagnosis, publish)


@pytest.fixture(scope="module", autouse=True)
def shared_replays() -> Iterator[None]:
    """Have every command take what was made before."""
    remembered = [_once(function) for function in SHARED]
    for function, instead in zip(SHARED, remembered, strict=True):
        _replace(function, instead)
    yield
    for function, instead in zip(SHARED, remembered, strict=True):
        _replace(instead, function)


def _once(function: Callable[..., Any]) -> Callable[..., Any]:
    """It, with a memory of what it made; what cannot be told apart is made each time."""
    made: dict[bytes, Any] = {}

    @functools.wraps(function)
    def remembered(*arguments: Any, **named: Any) -> Any:
        try:
            key = _digest(
                *arguments, *(value for _, value in sorted(named.items())), *sorted(named)
            )
        except (pickle.PicklingError, AttributeError, TypeError, OSError):  # no such file
            return function(*arguments, **named)
        if key not in made:
            made[key] = function(*arguments, **named)
        return made[key]

    return remembered


def _digest(*given: Any) -> bytes:
    """Of what is given, files with their time; whom to tell of the progress does not count."""
    told = [
        (value, value.stat().st_mtime_ns) if isinstance(value, Path) else value
        for value in given
        if not callable(value)
    ]
    text = io.BytesIO()
    _Named(text).dump(told)
    return hashlib.sha256(text.getbuffer()).digest()


class _Named(pickle.Pickler):
    """Functions by their names alone: whom to tell of the progress may be a method of anything."""

    def reducer_override(self, item: Any) -> Any:
        if isinstance(item, FunctionType | MethodType):
            return str, (item.__qualname__,)
        return NotImplemented


def _replace(item: Callable[..., Any], other: Callable[..., Any]) -> None:
    """In every module that has imported it."""
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] == "rtid":
            for known in [key for key, value in vars(module).items() if value is item]:
                setattr(module, known, other)
