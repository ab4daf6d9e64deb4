"""Public functions on arrays say in their docstring what shape and what unit they take and give."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("firmware_bridge", "rtid")
ARRAY = re.compile(r"\b(?:FloatArray|IntArray|BoolArray|NDArray)\b")
WITHOUT_UNIT = re.compile(r"\b(?:IntArray|BoolArray|NDArray\[np\.(?:bool_|u?int\w*|str_)\])")
SHAPE = re.compile(r"\((?:\.\.\.|[\w.+\-*/ ]+,[^()]*)\)")
UNIT = re.compile(
    r"\b(?:SI|dimensionless|units?|unit variance|scaled|whitened|shares?|index|seconds)\b"
    r"|(?<![\w'])(?:m|m2|m3|m/s|m/s2|m3/s|Pa|bar|1/Pa2?|m6|m6/s|m6/s2|V|s|Hz|rad/s|kg|N|W|J)\b|%"
)
UNIT_IN_NAME = re.compile(r"_(?:pa|m3s|m3|m2|m|s|us|v|hz|kg|n|mps|rad_s|percent)2?\b")


def public(path: Path) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Public functions and methods of a module, by their dotted names."""
    tree = ast.parse(path.read_text())
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    for home, body in (("", tree.body), *((f"{node.name}.", node.body) for node in classes)):
        for entry in body:
            if isinstance(entry, ast.FunctionDef) and not {home[:1], entry.name[0]} & {"_"}:
                yield home + entry.name, entry


def unsaid(function: ast.FunctionDef) -> str:
    """What the docstring of a function on arrays leaves open: shape, unit, both or nothing."""
    given = function.args
    arguments = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    nodes = [a.annotation for a in arguments if a.annotation]
    types = " ".join(map(ast.unparse, nodes + ([function.returns] if function.returns else [])))
    if not ARRAY.search(types):
        return ""
    text = ast.get_docstring(function) or ""
    names = " ".join((function.name, *(a.arg for a in arguments), text))
    needs_unit = ARRAY.search(WITHOUT_UNIT.sub("", types)) is not None
    has_unit = UNIT.search(text) or UNIT_IN_NAME.search(names)
    return " ".join(
        word
        for word, missing in (
            ("shape", not SHAPE.search(text)), ("unit", needs_unit and not has_unit)
        )
        if missing
    )  # fmt: skip


@pytest.mark.parametrize("package", PACKAGES)
def test_functions_on_arrays_name_shape_and_unit(package: str) -> None:
    missing = [
        f"{path.relative_to(ROOT)}: {name}: {words}"
        for path in sorted((ROOT / package).rglob("*.py"))
        for name, function in public(path)
        if (words := unsaid(function))
    ]
    assert not missing, "\n".join(missing)
