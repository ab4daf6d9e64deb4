"""What the tests of a run share: the same record is learned, diagnosed and published once.

A replay, a diagnosis and a map are functions of what they are given, bit for bit, and what follows
only reads them; so each command of a test need not begin anew.  What was made lies in a folder of
the run, and both workers take it from there.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import io
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import CodeType, FunctionType, MethodType
from typing import Any

import pytest

from firmware_bridge.kernel_cache import alone
from rtid.diagnose.diagnosis import search, searched
from rtid.diagnose.standing import fitted
from rtid.diagnose.summary import diagnosis
from rtid.diagnose.trials import TrialState
from rtid.estimator.published import publish
from rtid.excite.design import candidates
from rtid.excite.exciting import excite
from rtid.plain import silent
from rtid.sim.run import simulate
from rtid.study.known_effects import learn_acting
from tests.left import OF_RUN

SHARED: tuple[Callable[..., Any], ...] = (
    *(simulate, search, searched, diagnosis, publish, candidates, excite),
)
# Tens of MB each: kept by a module alone.
LARGE: tuple[Callable[..., Any], ...] = (fitted, learn_acting)
ROOT = str(Path(__file__).parents[1])
UNFIT = (pickle.PicklingError, AttributeError, TypeError, ValueError, OSError)


@pytest.fixture(scope="module", autouse=True)
def shared_replays(request: pytest.FixtureRequest) -> Iterator[None]:
    """Have every command, and every test of a module that imports this, take what was made."""
    folder, tests = Path(os.environ[OF_RUN]), vars(request.module)
    remembered = {function: _once(function, tests, folder) for function in SHARED}
    remembered |= {function: _once(function, tests) for function in LARGE}
    _replace(remembered)
    yield
    _replace({instead: function for function, instead in remembered.items()})


def _apart(tests: dict[str, Any]) -> str:
    """The test that runs, where it changes the program and must not share; else "".

    `EACH_APART` in a module: all of its tests do, by their fixtures.
    """
    name = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
    test = tests.get(name.rpartition("::")[2].partition("[")[0])
    if test is None:
        return ""
    changes = "EACH_APART" in tests or "monkeypatch" in inspect.signature(test).parameters
    return name if changes else ""


def _once(
    function: Callable[..., Any], tests: dict[str, Any], folder: Path | None = None
) -> Callable[..., Any]:
    """It, with a memory of what it made; what cannot be told apart is made each time."""
    own: dict[str, Any] = {}

    @functools.wraps(function)
    def remembered(*arguments: Any, **named: Any) -> Any:
        try:
            key = _digest(_apart(tests), arguments, sorted(named.items()))
        except UNFIT:
            return function(*arguments, **named)
        if folder is not None and key not in own:
            path = folder / f"{function.__qualname__}-{key}"
            made, is_kept = _kept(path, lambda: function(*arguments, **named))
            if is_kept:
                return made
            own[key] = made  # no pickle takes it
        if key not in own:
            own[key] = function(*arguments, **named)
        return own[key]

    return remembered


def _kept(path: Path, make: Callable[[], Any]) -> tuple[Any, bool]:
    """A copy of what lies in the file, and whether it does; one process makes what is not there."""
    with alone(path.with_name(f"{path.name}.lock")):
        if path.exists():
            return pickle.loads(path.read_bytes()), True
        made = make()
        with suppress(*UNFIT):
            path.write_bytes(pickle.dumps(made, pickle.HIGHEST_PROTOCOL))
    return made, path.exists()


def _digest(apart: str, arguments: tuple[Any, ...], named: list[tuple[str, Any]]) -> str:
    """Of what is given, files with their time; whom to tell of the progress does not count."""
    told = [
        (name, (value, value.stat().st_mtime_ns) if isinstance(value, Path) else value)
        for name, value in [*enumerate(arguments), *named]
        if not callable(value)
    ]
    text = io.BytesIO()
    pickler = _Named(text)
    pickler.fast = True  # a value and a copy of it are one, wherever either stands
    pickler.dump((apart, told))
    return hashlib.sha256(text.getbuffer()).hexdigest()[:32]


class _Named(pickle.Pickler):
    """Functions by what they do: a law may be a function within another, which no pickle takes.

    Objects without what they have worked out of themselves by then, or who hears of a search.
    """

    def reducer_override(self, item: Any) -> Any:
        if isinstance(item, MethodType):
            return str, (item.__func__.__qualname__,), item.__self__
        if isinstance(item, FunctionType):
            cells = [cell.cell_contents for cell in item.__closure__ or ()]
            return str, (item.__qualname__,), (item.__module__, item.__code__, cells)
        if isinstance(item, CodeType):
            return str, (item.co_name,), (item.co_code, item.co_names, item.co_consts)
        kind: Any = type(item)
        if isinstance(item, TrialState):  # each search begins anew, whoever hears of it
            item = replace(item.anew(silent), _coarse=None)
        elif not _lazy(kind):
            return NotImplemented
        state = {k: value for k, value in vars(item).items() if k not in _lazy(kind)}
        return str, (kind.__qualname__,), state


@functools.cache
def _lazy(kind: type) -> frozenset[str]:
    """What such an object works out of itself when it is first asked for it."""
    members = inspect.getmembers_static(kind, lambda v: isinstance(v, functools.cached_property))
    return frozenset(name for name, _ in members)


def _replace(others: dict[Callable[..., Any], Callable[..., Any]]) -> None:
    """In every module of this repository that has imported it."""
    by_identity = {id(function): other for function, other in others.items()}
    for module in list(sys.modules.values()):
        file = str(getattr(module, "__file__", None))
        if file.startswith(ROOT) and "site-packages" not in file:
            for name, value in list(vars(module).items()):
                if id(value) in by_identity:
                    setattr(module, name, by_identity[id(value)])
