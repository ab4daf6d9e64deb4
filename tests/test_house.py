"""One name for one thing: no class, module or parameter of rtid/ stands for two."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAMES_EFFECTS = {"hideable.py"}  # of the simulated machines; all others ask a page what it says
MODULES = sorted((ROOT / "rtid").rglob("*.py"))
SAY_NOTHING = {"found", "one", "told", "own", "left", "held"}  # the type has a name
# A command, what is said of it and its chart are named after the same subject; so are registries.
FACES = {"cli", "tell", "charts"}
REGISTRIES = {"__init__", "__main__", "errors"}


def arguments(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
        given = node.args
        for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs):
            yield argument.arg
        yield from (a.arg for a in (given.vararg, given.kwarg) if a)


def test_a_class_name_exists_once() -> None:
    homes = defaultdict[str, list[str]](list)
    for path in MODULES:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(str(path.relative_to(ROOT)))
    assert not {name: places for name, places in homes.items() if len(places) > 1}


def test_a_module_name_exists_once() -> None:
    homes = defaultdict[str, list[str]](list)
    for path in MODULES:
        if path.parent.name not in FACES and path.stem not in REGISTRIES:
            homes[path.stem].append(str(path.relative_to(ROOT)))
    assert not {name: places for name, places in homes.items() if len(places) > 1}


@pytest.mark.parametrize("package", sorted({p.relative_to(ROOT).parts[1] for p in MODULES}))
def test_parameters_have_the_name_of_what_they_are(package: str) -> None:
    said = [
        f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}: {name}"
        for path in MODULES
        if path.relative_to(ROOT).parts[1] == package
        for node in ast.walk(ast.parse(path.read_text()))
        for name in arguments(node)
        if name in SAY_NOTHING
    ]
    assert not said, "\n".join(said)


def test_an_effect_is_named_by_its_page_and_by_what_simulates_it() -> None:
    """No code asks for a catalogue effect by its name; a name of one word may mean other things."""
    names = {page.stem for page in (ROOT / "rtid/effects/pages").glob("*_*.toml")}
    said = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.value}"
        for path in MODULES
        if path.name not in NAMES_EFFECTS
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and node.value in names
    ]
    assert len(names) > 20 and not said, "\n".join(said)
