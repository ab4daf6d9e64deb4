"""Errors that the user can mend, and the doors that refuse a wrong argument by its name.

    @door
    def replay(project: Project, path: str | Path, ...) -> Replay: ...

Arguments are held against the function's own annotations: classes, `str | Path`, `X | None`,
arrays.  What an annotation says beyond that (Mapping, Callable, ...) is left to the function.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache, wraps
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, ParamSpec, TypeVar, get_args, get_origin

P = ParamSpec("P")
R = TypeVar("R")
REMEDIES = {
    "Project": "load it with rtid.project.load(path)",
    "Replay": "make it with rtid.study.replay.replay(project, path)",
    "Solution": "take it from an Estimator's solution(), or from a Replay's fit.solution",
    "Model": "take the model of a Project or of a Replay",
    "ndarray": "give a NumPy array; rtid.estimator.chunk.to_chunk makes one from Samples",
    "Path": "give a path as a text or a pathlib.Path",
}


class RtidError(Exception):
    """A refusal in plain words: what is wrong and where, and `remedy`, what to do about it.

    The command line prints both and ends with `exit_code` (see `rtid.cli.exits`).
    """

    exit_code = 3

    def __init__(self, message: str, remedy: str = "", exit_code: int | None = None) -> None:
        super().__init__(message)
        self.remedy = remedy
        if exit_code is not None:
            self.exit_code = exit_code


class ArgumentError(RtidError, TypeError):
    """An argument has a type that the function cannot use; the text names the argument."""

    exit_code = 2


def door(function: Callable[P, R]) -> Callable[P, R]:
    """Refuse arguments whose types the function's annotations exclude."""
    signature = inspect.signature(function)

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        wanted = _wanted(function)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if name in wanted and not isinstance(value, wanted[name]):
                refuse(_called(function), name, value, wanted[name])
        return function(*args, **kwargs)

    return checked


def _called(function: Callable[..., Any]) -> str:
    """What the user has called: a function, or the class whose __init__ it is."""
    return function.__qualname__.removesuffix(".__init__")


def refuse(function: str, name: str, value: object, wanted: tuple[type, ...]) -> None:
    """Raise the ArgumentError."""
    kinds = [kind.__name__ for kind in wanted if kind is not NoneType]
    problem = f"{function}: {name} must be {' or '.join(kinds)}, not {type(value).__name__}"
    remedy = next((REMEDIES[kind] for kind in reversed(kinds) if kind in REMEDIES), "")
    raise ArgumentError(f"{problem}; {remedy}" if remedy else problem, remedy)


def require(function: str, name: str, value: object, wanted: type) -> None:
    """The same for one argument of a method."""
    if not isinstance(value, wanted):
        refuse(function, name, value, (wanted,))


@cache
def _wanted(function: Callable[..., Any]) -> dict[str, tuple[type, ...]]:
    """Classes that each argument may be of, where its annotation tells."""
    parameters = inspect.signature(function).parameters.values()
    plain = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    kinds = {
        p.name: _classes(p.annotation, function)
        for p in parameters
        if p.kind in (*plain, inspect.Parameter.KEYWORD_ONLY) and p.annotation is not p.empty
    }
    return {name: classes for name, classes in kinds.items() if classes}


def _classes(annotation: Any, function: Callable[..., Any]) -> tuple[type, ...]:
    """The classes of an annotation; none where one of its parts is no plain class."""
    if isinstance(annotation, str):
        try:
            annotation = eval(annotation, vars(inspect.getmodule(function)))
        except NameError:  # imported for the type checker alone
            return ()
    parts = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    kinds = tuple(get_origin(part) or part or NoneType for part in parts)
    if not all(isinstance(kind, type) for kind in kinds):
        return ()
    numbers = {float: (Real,), int: (Integral,)}  # numpy's scalars are both
    if any(kind in (dict, list, tuple) for kind in kinds):
        return ()
    return tuple(whole for kind in kinds for whole in numbers.get(kind, (kind,)))
