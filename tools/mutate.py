"""Mutation check of the gates: change one operator, constant or statement; some test must fail.

    python -m tools.mutate [--out FILE] [--only WORD]

The kernels run as plain Python (numba's njit is replaced), so a mutant costs a fork, not a compile.
Each mutant of the functions in GATES is tried against tests/gates; what no test notices is
listed with its line.  A mutant that does not end within LIMIT_S is noticed as well.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import importlib
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np

TESTS = {  # each with the modules that it is about
    "test_frames": ("firmware_bridge.checks", "firmware_bridge.cycle"),
    "test_doubts": ("firmware_bridge.senders", "firmware_bridge.frozen"),
    "test_rows": ("rtid.kernels.gate", "rtid.kernels.engine"),
}
LIMIT_S = 30
GATES = {
    "firmware_bridge.checks": ("find_message", "_refuse", "check_sequence", "interpolate",
                               "read_roles", "admit"),
    "firmware_bridge.senders": ("_fill", "mark", "push", "doubted"),
    "firmware_bridge.frozen": ("run_limit", "judge", "push", "doubted"),
    "firmware_bridge.cycle": ("_open_slot", "_is_stale", "_close_older", "_flags", "_join",
                              "_complete", "push", "finish"),
    "rtid.kernels.gate": ("admitted", "forgive", "_judge", "_follow"),
    "rtid.kernels.engine": ("acceptable", "step_s", "_take"),
}  # fmt: skip
SWAPS: dict[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,),
    ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,),
    ast.And: (ast.Or,), ast.Or: (ast.And,), ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,),
    ast.LShift: (ast.RShift,), ast.RShift: (ast.LShift,),
}  # fmt: skip
CALLS = {"min": "max", "max": "min"}
Change = Callable[[ast.AST], None]
Test = Callable[[], None]


def without_numba() -> None:
    """Make numba's decorators give plain functions whose records have attributes."""

    def fields(value: Any) -> Any:
        if isinstance(value, tuple):
            made = map(fields, value)
            return type(value)(*made) if hasattr(value, "_fields") else tuple(made)
        if isinstance(value, np.ndarray) and value.dtype.names and value.dtype.type is np.void:
            return value.view(np.dtype((np.record, value.dtype)))
        return value

    def plain(function: Callable[..., Any] | None = None, **_options: Any) -> Any:
        if function is None:
            return plain

        def called(*arguments: Any) -> Any:
            return called.py_func(*map(fields, arguments))  # type: ignore[attr-defined]

        called.py_func = function  # type: ignore[attr-defined]
        return called

    def floor(value: float, whole: Callable[[float], int] = math.floor) -> float:
        return whole(value) if math.isfinite(value) else value  # as compiled: no exception

    numba.njit, math.floor = plain, floor  # type: ignore[assignment]
    layout = importlib.import_module("rtid.kernels.layout")
    for name, value in vars(layout).items():
        if isinstance(value, np.dtype) and value.names:
            setattr(layout, name, np.dtype((np.record, value)))


def mutants(tree: ast.Module, names: tuple[str, ...]) -> Iterator[tuple[int, str, ast.Module]]:
    """Line, what was changed, and the changed module, for each mutant of the named functions."""
    places = [
        (k, change, said)
        for k, node in enumerate(ast.walk(tree))
        if id(node) in _inside(tree, names)
        for change, said in _changes(node)
    ]
    for k, change, said in places:
        copied = copy.deepcopy(tree)
        node = list(ast.walk(copied))[k]
        change(node)
        yield getattr(node, "lineno", 0), said, ast.fix_missing_locations(copied)


def _inside(tree: ast.Module, names: tuple[str, ...]) -> set[int]:
    """The nodes in the bodies of these functions; docstrings and annotations are not code."""
    lines: set[int] = set()
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef) and function.name in names:
            for statement in function.body:
                if not (
                    isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
                ):
                    lines |= {id(node) for node in ast.walk(statement)}
    return lines


def _changes(node: ast.AST) -> Iterator[tuple[Change, str]]:
    """The ways to change one node."""
    if isinstance(node, ast.Compare):
        for k, operator in enumerate(node.ops):
            for other in SWAPS.get(type(operator), ()):
                yield _set_item("ops", k, other()), f"{_name(operator)} -> {other.__name__}"
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign):
        for other in SWAPS.get(type(node.op), ()):
            yield _set("op", other()), f"{_name(node.op)} -> {other.__name__}"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield _set("op", ast.UAdd()), "not dropped"
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CALLS:
        other_name = CALLS[node.func.id]
        yield _set("func", ast.Name(other_name, ast.Load())), f"{node.func.id} -> {other_name}"
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield _set("value", not node.value), f"{node.value} -> {not node.value}"
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield _set("value", node.value + 1), f"{node.value} -> {node.value + 1}"
    if isinstance(node, ast.Assign | ast.AugAssign | ast.Expr | ast.Continue):
        yield _emptied, f"dropped: {ast.unparse(node)[:60]}"


def _name(node: ast.AST) -> str:
    return type(node).__name__


def _set(field: str, value: Any) -> Change:
    return lambda node: setattr(node, field, value)


def _set_item(field: str, k: int, value: Any) -> Change:
    return lambda node: getattr(node, field).__setitem__(k, value)


def _emptied(node: ast.AST) -> None:
    """Turn a statement into `pass`, in place."""
    node.__class__ = ast.Pass
    vars(node)["_fields"] = ()


def installed(module: ModuleType, tree: ast.Module, names: tuple[str, ...]) -> None:
    """Put the functions of a changed module in the place of the present ones, wherever they are."""
    fresh: dict[str, Any] = dict(vars(module))
    exec(compile(tree, module.__file__ or "", "exec"), fresh)
    for name in names:
        if name in vars(module):
            _replace(vars(module)[name], fresh[name])
    for owner in [v for v in vars(module).values() if isinstance(v, type)]:
        if owner.__module__ == module.__name__:
            for name in set(names) & set(vars(owner)):
                setattr(owner, name, vars(fresh[owner.__name__])[name])


def _replace(old: object, new: object) -> None:
    """In every module that has imported it."""
    for module in list(sys.modules.values()):
        if module.__name__.split(".")[0] in ("rtid", "firmware_bridge", "tests"):
            for name, value in list(vars(module).items()):
                if value is old:
                    setattr(module, name, new)


def cases(module: ModuleType) -> list[Test]:
    """Every test of a module with each of its parameters: functions without fixtures."""
    tests = [test for name, test in vars(module).items() if name.startswith("test_")]
    return [partial(test, **given) for test in tests for given in _given(test)]


def _given(test: Callable[..., None]) -> list[dict[str, Any]]:
    """The arguments of `pytest.mark.parametrize`, all combinations."""
    given: list[dict[str, Any]] = [{}]
    for mark in getattr(test, "pytestmark", ()):
        names, values = mark.args
        keys = [names] if isinstance(names, str) else list(names)
        rows = [dict(zip(keys, v if len(keys) > 1 else (v,), strict=True)) for v in values]
        given = [case | row for case in given for row in rows]
    return given


def is_noticed(install: Callable[[], None], tests: list[Test]) -> bool:
    """Whether a test fails in a child process that has the mutant."""
    child = os.fork()
    if child == 0:
        signal.alarm(LIMIT_S)
        code = 1
        with contextlib.suppress(BaseException):
            install()
            for test in tests:
                test()
            code = 0
        os._exit(code)
    _, status = os.waitpid(child, 0)
    return status != 0


def main() -> None:
    """Try all mutants; exit code 1 where fewer than 90 % are noticed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("tests/gates/mutants.txt"))
    parser.add_argument("--only", default="", help="modules whose name contains this")
    wanted = parser.parse_args()
    without_numba()
    modules = {n: importlib.import_module(n) for n in GATES if wanted.only in n}
    known = {name: cases(importlib.import_module(f"tests.gates.{name}")) for name in TESTS}
    if is_noticed(lambda: None, [t for some in known.values() for t in some]):
        sys.exit("tests/gates fails without any mutant")
    lines, tried, missed = list[str](), 0, 0
    for name, module in modules.items():
        tree = ast.parse(Path(module.__file__ or "").read_text("utf-8"))
        first = sorted(TESTS, key=lambda t: name not in TESTS[t])
        tests = [test for name in first for test in known[name]]
        n = k = 0
        for line, said, mutant in mutants(tree, GATES[name]):
            n += 1
            if not is_noticed(lambda m=module, t=mutant, g=GATES[name]: installed(m, t, g), tests):  # type: ignore[misc]
                k += 1
                lines.append(f"  {name}:{line}: {said}")
                print(lines[-1], flush=True)
        lines.insert(len(lines) - k, f"{name}: {n - k} of {n} noticed")
        print(f"{name}: {n - k} of {n} noticed", flush=True)
        tried, missed = tried + n, missed + k
    share = 1 - missed / max(1, tried)
    head = f"{tried - missed} of {tried} mutants noticed ({share:.1%}), {time.strftime('%Y-%m-%d')}"
    wanted.out.write_text("\n".join([head, *lines]) + "\n", "utf-8")
    print(head)
    sys.exit(share < 0.9)


if __name__ == "__main__":
    main()
