"""The cases: which input is mutated, and the command that it goes through.

A case is named by seed, kind and number alone, so that one of them can be made again:
`make fuzz FUZZ="--case logs-17"`.
"""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from scipy.io import savemat

from tests.fuzz import mutate
from tests.fuzz.bombs import BOMBS
from tests.fuzz.seeds import LOGS, TABLES, Seeds, write_mcap

KINDS = ("projects", "dbcs", "nodes", "logs", "tables", "plants", "bombs")
HARMLESS_SHARE = 0.02  # of the cases that stay as they are: what is sound must pass


@dataclass(frozen=True)
class Case:
    """A command line, and what must come out of it.

    expected: rows (of a table) or frames (of a log) that the mutation has left or damaged and that
    must be counted, as samples or as refusals; None where it may have taken whole rows away.
    """

    kind: str
    number: int
    arguments: tuple[str, ...]
    mutated: Path
    expected: int | None = None

    @property
    def name(self) -> str:
        """As in the table of failures."""
        return f"{self.kind}-{self.number}"


def make(seeds: Seeds, seed: int, kind: str, number: int, folder: Path) -> Case:
    """Write the inputs of one case into `folder`."""
    rng = random.Random(f"{seed}/{kind}/{number}")
    shutil.copytree(seeds.folder, folder, dirs_exist_ok=True, copy_function=_link)
    mutated, expected, arguments = _MAKERS[kind](seeds, rng, folder)
    return Case(kind, number, tuple(arguments), mutated, expected)


def _link(source: str, target: str) -> None:
    Path(target).symlink_to(source)


def _replace(path: Path, content: bytes) -> None:
    path.unlink()
    path.write_bytes(content)


Made = tuple[Path, int | None, list[str]]


def _project(seeds: Seeds, rng: random.Random, folder: Path) -> Made:
    name = rng.choice(seeds.projects)
    path = folder / name
    text = path.read_text("utf-8")
    if rng.random() > HARMLESS_SHARE:
        by_value = rng.random() < 0.7
        changed = mutate.of_toml(text, rng) if by_value else mutate.of_text(text.encode(), rng)
        _replace(path, changed)
    trace = str(folder / ("table.parquet" if name == "table.toml" else "log.blf"))
    project = ["-p", str(path)]
    commands = (
        ["check", str(path)],
        ["check", str(path), trace, "--json"],
        ["replay", trace, *project, "--json"],
        ["replay", trace, *project],
        ["compare", trace, *project, "--json"],
        ["diagnose", trace, *project, "--json"],
        ["export", trace, str(folder / "map.json"), *project],
        ["excite", *project, str(folder / "motion.csv"), "--json"],
        ["history", *project],
    )
    return path, None, rng.choices(commands, (4, 3, 4, 1, 1, 1, 1, 1, 1))[0]


def _dbc(_seeds: Seeds, rng: random.Random, folder: Path) -> Made:
    path = folder / "machine.dbc"
    content = path.read_bytes()
    if rng.random() > HARMLESS_SHARE:
        change = _doubled_message if rng.random() < 0.1 else mutate.of_text
        content = change(content, rng)
        _replace(path, content)
    log, project = str(folder / "log.blf"), str(folder / "log.toml")
    commands = (
        ["init", str(path), "-o", str(folder / "new.toml")],
        ["check", "--bus-only", log, "--dbc", str(path), "--json"],
        ["check", project, log, "--json"],
        ["replay", log, "-p", project, "--json"],
        ["quick", log, "--dbc", str(path), "--json"],
    )
    return path, None, rng.choice(commands)


def _nodes(_seeds: Seeds, rng: random.Random, folder: Path) -> Made:
    """An EDS or DCF of one of three nodes."""
    path = folder / rng.choice(("valve.eds", "sensor.eds", "encoder.dcf"))
    if rng.random() > HARMLESS_SHARE:
        _replace(path, mutate.of_text(path.read_bytes(), rng))
    names = ",".join(
        map(str, (folder / "valve.eds:5", folder / "sensor.eds:9", folder / "encoder.dcf"))
    )
    log = str(folder / "nodes.blf")
    commands = (
        ["init", names, "-o", str(folder / "new.toml")],
        ["check", "--bus-only", log, "--dbc", names, "--json"],
        ["quick", log, "--dbc", names, "--json"],
    )
    return path, None, rng.choice(commands)


def _doubled_message(content: bytes, rng: random.Random) -> bytes:
    """One message once more: with the same name, the same identifier, or both."""
    blocks = re.findall(rb"(?ms)^BO_ .*?\n(?=\n)", content)
    chosen: bytes = rng.choice(blocks)
    new = re.sub(rb"^BO_ \d+", b"BO_ 777", chosen) if rng.random() < 0.5 else chosen
    if rng.random() < 0.5:
        new = re.sub(rb"^(BO_ \d+) \w+", rb"\1 Another", new)
    return content.replace(chosen, chosen + b"\n" + new)


def _log(seeds: Seeds, rng: random.Random, folder: Path) -> Made:
    suffix = rng.choice(LOGS)
    path = folder / f"log{suffix}"
    content, expected = path.read_bytes(), None
    if rng.random() > HARMLESS_SHARE:
        of = mutate.of_bytes if suffix in (".blf", ".asc.gz", ".mf4") else mutate.of_text
        _replace(path, of(content, rng))
    else:
        expected = seeds.frames
    project = str(folder / "log.toml")
    commands = (
        ["check", "--bus-only", str(path), "--json"],
        ["check", "--bus-only", str(path)],
        ["check", project, str(path), "--json"],
        ["replay", str(path), "-p", project, "--json"],
        ["quick", str(path), "--dbc", str(folder / "machine.dbc"), "--json"],
    )
    return path, expected, rng.choices(commands, (6, 1, 2, 2, 2))[0]


def _table(seeds: Seeds, rng: random.Random, folder: Path) -> Made:
    if rng.random() < 0.2:
        return _record(seeds, rng, folder)
    suffix = rng.choice(TABLES)
    path = folder / f"table{suffix}"
    expected: int | None = seeds.rows
    if rng.random() > HARMLESS_SHARE:
        expected = _mutate_table(path, rng)
    project = str(folder / "table.toml")
    commands = (
        ["quick", str(path), "--json"],
        ["quick", str(path)],
        ["check", project, str(path), "--json"],
        ["replay", str(path), "-p", project, "--json"],
        ["diagnose", str(path), "-p", project, "--json"],
        ["init", str(path), "-o", str(folder / "new.toml")],
    )
    return path, expected, rng.choices(commands, (3, 1, 4, 3, 1, 1))[0]


def _record(seeds: Seeds, rng: random.Random, folder: Path) -> Made:
    """The record of a plant that is given by its equations."""
    name = rng.choice(seeds.plants)
    path = folder / f"{name}.csv"
    _replace(path, mutate.of_text(path.read_bytes(), rng))
    return path, None, ["refit", str(folder / f"{name}.toml"), str(path), "--json"]


def _mutate_table(path: Path, rng: random.Random) -> int | None:
    """Change bytes, or columns; then the number of rows is known."""
    if rng.random() < 0.4 or path.suffix == ".mf4":
        binary = path.suffix in (".parquet", ".mat", ".mcap", ".mf4")
        of = mutate.of_bytes if binary else mutate.of_text
        _replace(path, of(path.read_bytes(), rng))
        return None
    whole = pyarrow.parquet.read_table(path.with_name("table.parquet"))
    columns = {name: whole[name].to_numpy() for name in whole.column_names}
    columns = mutate.of_columns(columns, rng)
    path.unlink()
    _WRITERS[path.suffix](path, columns)
    return len(next(iter(columns.values())))


def _arrow(columns: dict[str, np.ndarray]) -> pa.Table:
    return pa.table({name: pa.array(column) for name, column in columns.items()})


def _write_text(path: Path, columns: dict[str, np.ndarray]) -> None:
    delimiter = "\t" if path.suffix == ".tsv" else ","
    options = pyarrow.csv.WriteOptions(delimiter=delimiter)
    pyarrow.csv.write_csv(_arrow(columns), path, options)


def _write_mat(path: Path, columns: dict[str, np.ndarray]) -> None:
    named = {re.sub(r"\W", "_", name)[:31] or "p": c for name, c in columns.items()}
    savemat(path, {name if name[0].isalpha() else "c" + name: c for name, c in named.items()})


_WRITERS: dict[str, Callable[[Path, dict[str, np.ndarray]], None]] = {
    ".parquet": lambda path, columns: pyarrow.parquet.write_table(_arrow(columns), path),
    ".csv": _write_text,
    ".tsv": _write_text,
    ".mat": _write_mat,
    ".mcap": write_mcap,
}


def _plant(seeds: Seeds, rng: random.Random, folder: Path) -> Made:
    name = rng.choice(seeds.plants)
    path = folder / f"{name}.toml"
    text = path.read_text("utf-8")
    if rng.random() > HARMLESS_SHARE:
        by_value = rng.random() < 0.7
        changed = mutate.of_toml(text, rng) if by_value else mutate.of_text(text.encode(), rng)
        _replace(path, changed)
    more = rng.choices(([], ["--diagnose"], ["--add", "overflow:x1"]), (12, 1, 1))[0]
    return path, None, ["refit", str(path), str(folder / f"{name}.csv"), "--json", *more]


def _bomb(_seeds: Seeds, rng: random.Random, folder: Path) -> Made:
    name = rng.choice(list(BOMBS))
    path = folder / name
    BOMBS[name](path)
    project = str(folder / f"{name.partition('.')[0]}.toml")
    commands = [
        ["check", project, str(path), "--json"],
        ["replay", str(path), "-p", project, "--json"],
        ["quick", str(path), "--json"],
    ]
    return path, None, rng.choice(commands)


_MAKERS: dict[str, Callable[[Seeds, random.Random, Path], Made]] = {
    "projects": _project, "dbcs": _dbc, "nodes": _nodes, "logs": _log, "tables": _table,
    "plants": _plant, "bombs": _bomb,
}  # fmt: skip
