"""Which test modules a change touches, nearest first: by who imports what it changes.

A name that a package passes on counts for the module that defines it, so that a change of one
module of a package does not touch all who import the package.  An import within a function counts.
What is no Python (a DBC, a C source, a page's script) belongs to the modules that say its name.
"""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

TOPS = ("rtid", "firmware_bridge", "tests", "tools", "benchmarks")
MAIN = "main", "origin/main"


def changed(root: Path, since: str = "") -> list[Path]:
    """Files that differ from where this branch left `main`, those not yet added included.

    since: compare with this revision instead.
    """
    names = _git(root, "diff", "--name-only", since or _base(root))
    names += _git(root, "ls-files", "--others", "--exclude-standard")
    return [root / name for name in dict.fromkeys(names)]


def _base(root: Path) -> str:
    """Where this branch left `main`; where there is none, what was committed last."""
    known = _git(root, "for-each-ref", "--format=%(refname:short)", "refs/heads", "refs/remotes")
    name = next((name for name in MAIN if name in known), "HEAD")
    return _git(root, "merge-base", "HEAD", name)[0]


def _git(root: Path, *words: str) -> list[str]:
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


@dataclass(frozen=True)
class Sources:
    """The Python modules under a root, and who imports whom."""

    root: Path

    @cached_property
    def paths(self) -> dict[str, Path]:
        """Where each module lies, by its dotted name."""
        files = (p for top in TOPS for p in (self.root / top).rglob("*.py"))
        return {self._name(path): path for path in files}

    def _name(self, path: Path) -> str:
        parts = path.relative_to(self.root).with_suffix("").parts
        return ".".join(parts).removesuffix(".__init__")

    @cached_property
    def _imports(self) -> dict[str, list[tuple[str, str, str]]]:
        """What each module imports: the module, the name there ("" for all), its name here."""
        return {name: list(_imported(path)) for name, path in self.paths.items()}

    @cached_property
    def importers(self) -> dict[str, set[str]]:
        """The modules that import each module."""
        result: dict[str, set[str]] = {name: set() for name in self.paths}
        for name, imported in self._imports.items():
            for module, what, _ in imported:
                for target in self._defined(module, what, set()):
                    result[target].add(name)
        return result

    def _defined(self, module: str, what: str, seen: set[tuple[str, str]]) -> set[str]:
        """The modules that `from module import what` depends on."""
        whole = f"{module}.{what}" if what else module
        if whole in self.paths:
            return {whole}
        if module not in self.paths or (module, what) in seen:
            return set()
        passed = [(m, w) for m, w, here in self._imports[module] if what and here == what]
        further = (self._defined(m, w, seen | {(module, what)}) for m, w in passed)
        return set[str]().union(*further) or {module}

    def distances(self, files: Iterable[Path]) -> dict[str, int]:
        """How many imports lie between each module and the nearest of the files."""
        result = dict.fromkeys((name for file in files for name in self._belongs(file)), 0)
        front = list(result)
        while front:
            nearer, front = front, []
            for name in nearer:
                for importer in self.importers[name] - result.keys():
                    result[importer] = result[name] + 1
                    front.append(importer)
        return result

    def _belongs(self, file: Path) -> Iterator[str]:
        """The module of a file (of a package: and all who import from it), or who says its name."""
        if file.suffix == ".py":
            if file in self.paths.values():
                yield (name := self._name(file))
                if file.stem == "__init__":
                    yield from (
                        n for n, some in self._imports.items() if name in {m for m, *_ in some}
                    )
            return
        yield from (n for n, path in self.paths.items() if file.name in path.read_text("utf-8"))

    def tests(self, files: Iterable[Path]) -> dict[Path, int]:
        """Test modules that the files touch, with their distance: their namesakes, then by it."""
        files = list(files)
        stems = {file.parent.name if file.stem == "__init__" else file.stem for file in files}

        def rank(item: tuple[str, int]) -> tuple[bool, int, str]:
            name, distance = item
            return not any(stem in name for stem in stems), distance, name

        near = sorted(self.distances(files).items(), key=rank)
        return {self.paths[n]: k for n, k in near if self.paths[n].name.startswith("test_")}


def _imported(path: Path) -> Iterator[tuple[str, str, str]]:
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "", "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                yield node.module, alias.name, alias.asname or alias.name
