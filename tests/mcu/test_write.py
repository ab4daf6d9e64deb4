"""What `rtid mcu` writes and refuses, and what it costs on a controller."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtid.estimator.state import Weights, nominal_weights
from rtid.mcu.c_tables import sizes_of, tables
from rtid.mcu.emulated import Record
from rtid.mcu.errors import ValveError
from rtid.mcu.memory import Layout
from rtid.mcu.valve import one_valve
from rtid.mcu.write import write_sources
from rtid.model import LAPPED, Term, Upkeep
from rtid.project import load
from tests.command import ends
from tests.mcu.compiled import COMPILER, STRICT, Program
from tests.mcu.machine import BLOCKS, Reference, small_valve, sums_apart
from tests.rig import PROJECT


def arm_compiler() -> str | None:
    """The cross compiler; None where it, or the headers of its library, are not there."""
    found = shutil.which("arm-none-eabi-gcc")
    if found is None:
        return None
    trial = [found, "-fsyntax-only", "-xc", "-include", "math.h", "/dev/null"]
    done = subprocess.run(trial, capture_output=True, check=False)
    return found if done.returncode == 0 else None


ARM = arm_compiler()
# Bytes of flash for code and tables of the small grid: more than, less than
TARGETS = {
    "Cortex-M4, float32": (
        ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-DRTID_ESTIMATOR_FLOAT32"),
        (8_000, 14_800),
    ),
    "Cortex-M7, float64": (("-mcpu=cortex-m7", "-mfpu=fpv5-d16"), (7_000, 13_000)),
}
UPDATE_STACK, SOLVE_STACK = 1_400, 2_400  # bytes


def command(*arguments: str) -> int:
    """Exit code of `rtid mcu`."""
    return ends("mcu", *arguments)


def test_command_writes_a_folder_that_compiles(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if COMPILER is None:
        pytest.skip("no cc, gcc or clang on this machine: the estimator in C is not tested")
    folder, chosen = tmp_path / "controller", ("-c", "a", "-e", "pa", "--blocks", "9")
    assert command(str(folder), "-p", str(PROJECT), *chosen, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["blocks"] == 9
    assert told["ram_bytes"]["float32"][0] < told["ram_bytes"]["float64"][0] < 40_000
    assert {Path(name).parent for name in told["written"]} == {folder}
    for source in folder.glob("*.c"):
        build = [COMPILER, *STRICT, "-fsyntax-only", str(source)]
        subprocess.run(build, check=True, cwd=folder)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("-c", "c"), "there is no chamber 'c'"),
        (("-c", "a", "-e", "pb"), "there is no edge of chamber a 'pb'"),
        (("-c", "a", "--blocks", "1"), ""),
    ],
)
def test_command_refuses_in_plain_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], named: str
) -> None:
    code = command(str(tmp_path / "c"), "-p", str(PROJECT), *arguments)
    assert code == (2 if named else 0)
    assert named in capsys.readouterr().err


def test_noise_that_is_to_be_estimated_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = tmp_path / "p.toml"
    project.write_text(PROJECT.read_text().replace("noise = 10e-6", 'noise = "estimate"'))
    assert command(str(tmp_path / "c"), "-p", str(project)) == 2
    assert "signals.x.noise" in capsys.readouterr().err


def test_what_a_record_told_of_the_machine_is_in_the_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As on board: a dead volume that was found is the chamber's own, and its lag the spools'."""
    project, model = tmp_path / "p.toml", load(PROJECT).model
    text = PROJECT.read_text().replace(
        "[dynamics.spool_lag]", "[dynamics.spool_lag]\nseen_ms = 0.9"
    )
    volume = 'parameters = { volume = { value = 2e-4, unit = "m3" } }'
    project.write_text(f'{text}\n[[added]]\neffect = "extra_dead_volume"\nwhere = "a"\n{volume}\n')
    folder = tmp_path / "c"
    assert command(str(folder), "-p", str(project), "-c", "a", "-e", "pa", "--json") == 0
    assert json.loads(capsys.readouterr().out)["without"] == []
    written = "".join(path.read_text() for path in folder.glob("*.h"))
    numbers = dict(re.findall(r"#define RTID_EST_(V0|LAG)\s+\(?([0-9.e+-]+)", written))
    assert float(numbers["V0"]) == pytest.approx(model.chambers[0].v0_m3 + 2e-4)
    assert float(numbers["LAG"]) == pytest.approx(0.9e-3)


def test_everything_that_it_does_not_do_is_named() -> None:
    model = load(PROJECT).model
    term = Term("air", (("p_a", 1.0),), (("a", 1),), 1.0, 1e5, "linear", rate=True, volume="b")
    upkeep = Upkeep(10.0, forget_s=600.0, innovation_sd=8.0, folds=5)
    edges = (replace(model.edges[0], basis=LAPPED, modes=(1,)), *model.edges[1:])
    whole = replace(model, form="carry", terms=(term,), upkeep=upkeep, edges=edges)
    with pytest.raises(ValveError) as refused:
        one_valve(whole, "a")
    for word in ("form", "forget", "innovation", "folds", "basis", "modes", "volume of chamber b"):
        assert word in str(refused.value), word


def test_too_many_blocks_are_refused() -> None:
    grid = np.linspace(1.0, 8.0, 101)
    model = one_valve(load(PROJECT).model, "a")
    fine = tuple(replace(e, grid=replace(e.grid, u_v=grid, dp_pa=grid * 1e6)) for e in model.edges)
    with pytest.raises(ValveError, match="2000 blocks"):
        sizes_of(replace(model, edges=fine))


def test_names_that_are_no_c_are_made_so(tmp_path: Path) -> None:
    model = small_valve()
    signals = tuple(replace(s, name={"u": "u*/ä"}.get(s.name, s.name)) for s in model.signals)
    edges = tuple(replace(e, command="u*/ä", name=f"{e.name}*/") for e in model.edges)
    text = tables(replace(model, signals=signals, edges=edges))
    assert "RTID_EST_COLUMN_U___" in text
    assert re.sub(r"/\*.*?\*/", "", text).count("*/") == 0


def test_names_that_are_one_in_c_are_refused() -> None:
    model = small_valve()
    signals = tuple(
        replace(s, name={"p_a": "P A", "p_supply": "p-a"}.get(s.name, s.name))
        for s in model.signals
    )
    edges = tuple(replace(e, source="p-a", sink="P A", signs=(("a", 1),)) for e in model.edges[:1])
    chambers = (replace(model.chambers[0], pressure="P A"),)
    with pytest.raises(ValveError, match="RTID_EST_COLUMN_P_A"):
        tables(replace(model, signals=signals, edges=edges, chambers=chambers))


def test_learned_weights(tmp_path: Path) -> None:
    """Slopes and missed flow of a first pass weigh the rows as in Python."""
    model, rng = small_valve(), np.random.default_rng(3)
    nominal = nominal_weights(model)
    slopes = nominal.slopes * rng.uniform(0.5, 2.0, len(nominal.slopes))
    weights = Weights(slopes, nominal.compliance * 1.1, 2e-3, 1e-16 * rng.random(len(slopes)))
    t_us = 1000 * np.arange(4000)
    wave = np.sin(1e-6 * np.outer(t_us, rng.uniform(2, 40, len(model.signals))))
    values = np.array([{"u": 6.0, "x": 0.2}.get(s.name, 1e6) for s in model.signals]) * wave
    values += [{"u": 0.0, "x": 0.25, "p_supply": 7e6}.get(s.name, 3e6) for s in model.signals]
    record = Record(t_us, values, np.ones(len(t_us)))
    reference = Reference.of(model, record, weights)
    program = Program(model, tmp_path, BLOCKS, weights=weights)
    outcome = program.run(program.samples(record.t_us, record.values, record.flags))
    assert len(reference.solution.blocks) > 5
    assert sums_apart(outcome, reference) <= 1e-10


def test_a_written_folder_is_whole(tmp_path: Path) -> None:
    names = {path.name for path in write_sources(tmp_path, small_valve(), BLOCKS)}
    assert names == {path.name for path in tmp_path.iterdir()}


@pytest.fixture(scope="module", params=TARGETS)
def compiled(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, dict[str, int], dict[str, int]]:
    """Name of the target; bytes of text, data and bss; stack of each source's functions."""
    if ARM is None:
        needed = "gcc-arm-none-eabi and libnewlib-arm-none-eabi (Debian)"
        pytest.skip(f"needs {needed}: sizes are not measured")
    folder = tmp_path_factory.mktemp("arm")
    write_sources(folder, small_valve(), BLOCKS)
    cpu = (*TARGETS[request.param][0], "-mfloat-abi=hard", "-mthumb")
    sources = sorted(path.name for path in folder.glob("*.c"))
    (folder / "size.c").write_text(_same_memory("-DRTID_ESTIMATOR_FLOAT32" in cpu))
    subprocess.run([ARM, *STRICT, *cpu, "-fsyntax-only", "size.c"], check=True, cwd=folder)
    build = [ARM, *STRICT, "-Os", "-fstack-usage", *cpu, "-c", *sources]
    subprocess.run(build, check=True, cwd=folder)
    stack = dict(_stack(folder))
    sizes = subprocess.run(
        ["arm-none-eabi-size", *(path.name for path in folder.glob("*.o"))],
        check=True, capture_output=True, text=True, cwd=folder,
    ).stdout  # fmt: skip
    rows = np.array([line.split()[:3] for line in sizes.splitlines()[1:]], int)
    return request.param, dict(zip(("text", "data", "bss"), rows.sum(0), strict=True)), stack


def _same_memory(single: bool) -> str:
    """Does not compile where the records are not of the size that `rtid mcu` tells."""
    layout = Layout(sizes_of(small_valve(), BLOCKS), single)
    sizes = {"rtid_estimator": layout.estimator, "rtid_estimator_work": layout.work}
    checks = (
        f"extern char same_{name}[sizeof({name}) == {record.itemsize} ? 1 : -1];"
        for name, record in sizes.items()
    )
    return "\n".join(['#include "rtid_estimator.h"', *checks, ""])


def _stack(folder: Path) -> Iterator[tuple[str, int]]:
    """Stack of all functions of each source: no recursion, so no chain of calls takes more."""
    for path in folder.glob("*.su"):
        rows = [line.split("\t") for line in path.read_text().splitlines()]
        assert {kind for _, _, kind in rows} == {"static"}  # none depends on data
        yield path.stem, sum(int(size) for _, size, _ in rows)


def test_size_on_a_controller(compiled: Any) -> None:
    """Code and tables in flash; nothing of its own in RAM: that is the caller's."""
    name, sizes, _ = compiled
    print(f"{name}: {sizes}")
    low, high = TARGETS[name][1]
    assert low < sizes["text"] < high
    assert sizes["data"] == sizes["bss"] == 0


def test_stack_is_bounded(compiled: Any) -> None:
    name, _, stack = compiled
    sums, solve = stack["rtid_estimator_sums"], stack["rtid_estimator_solve"]
    update = stack["rtid_estimator"] + stack["rtid_estimator_interval"] + sums
    print(f"{name}: update {update}, solve {solve + sums} bytes of stack at most")
    assert update < UPDATE_STACK
    assert solve + sums < SOLVE_STACK
