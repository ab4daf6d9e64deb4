"""What README and docs/api.md name: importable, takes texts and paths, refuses by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_bridge.samples import Samples
from rtid.errors import ArgumentError
from rtid.estimator.batch import fit_batch
from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.estimator.published import publish
from rtid.estimator.record import fit_record
from rtid.excite.exciting import excite
from rtid.maps.datasheet import read_reference
from rtid.maps.files import read_map, write_map
from rtid.maps.prior_map import find_prior, published
from rtid.project import Project, load
from rtid.project.history import history
from rtid.project.plant_file import load_plant
from rtid.sim.declare import declared_model
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.compared import compare_trace, spans_of_block
from rtid.study.replay import Replay, replay
from rtid.study.revisions import add, drop, undo
from rtid.study.study import diagnose_live, diagnose_trace
from rtid.trace.reading import read_trace
from rtid.trace.snapshot import load as load_snapshot
from rtid.trace.snapshot import save
from tests.replays import shared_replays  # noqa: F401

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/api.md", "docs/guide.md", "docs/extending.md")


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = simulate(SimulatedPlant(), "rich", 0, 1.5)
    return write_run(str(tmp_path_factory.mktemp("doors") / "run.blf"), run, 0, "rich")[0]


@pytest.fixture(scope="module")
def project(trace: Path) -> Project:
    return load(str(trace.with_suffix(".toml")))


@pytest.fixture(scope="module")
def result(project: Project, trace: Path) -> Replay:
    return replay(project, str(trace))


def test_every_name_in_the_pages_can_be_imported() -> None:
    named = {
        n for page in PAGES for n in re.findall(r"`(rtid(?:\.\w+)+)", (ROOT / page).read_text())
    }
    assert len(named) > 40
    for name in sorted(n for n in named if not n.endswith((".toml", ".md", ".m"))):
        owner, _, last = name.rpartition(".")
        try:
            import_module(name)
        except ModuleNotFoundError:
            assert hasattr(import_module(owner), last), f"{name} cannot be imported"


WRONG: list[tuple[Callable[..., Any], tuple[Any, ...], str]] = [
    (load, (3,), "path"),
    (load_plant, (3,), "path"),
    (read_trace, ("machine.toml", "x.blf"), "project"),
    (replay, ("machine.toml", "x.blf"), "project"),
    (diagnose_trace, ("machine.toml", "x.blf"), "project"),
    (excite, ("machine.toml",), "project"),
    (find_prior, ("machine.toml",), "project"),
    (diagnose_live, ("x.npz",), "estimator"),
    (compare_trace, ("x.blf",), "result"),
    (spans_of_block, ("x.blf", "pa", 0, 0), "comparison"),
    (publish, ("x.npz",), "solution"),
    (published, ("x.npz", None), "solution"),
    (to_chunk, ("model", None, 0), "model"),
    (fit_record, ("model", np.zeros((3, 9))), "model"),
    (fit_batch, ("model", np.zeros(3), np.zeros((3, 7))), "model"),
    (read_map, (3,), "path"),
    (read_reference, (3,), "path"),
    (write_map, ("map.json", "map", {}), "flowmap"),
    (add, (3, "x.blf"), "project"),
    (drop, (3, "leak"), "project"),
    (undo, (None,), "project"),
    (history, (None,), "project"),
    (save, ("x.npz", "estimator", ""), "estimator"),
    (load_snapshot, ("x.npz", "model", ""), "model"),
    (simulate, ("plant",), "plant"),
    (write_run, ("x.blf", "run", 0, "rich"), "run"),
    (declared_model, ("plant",), "plant"),
]


@pytest.mark.parametrize(
    ("function", "arguments", "name"), WRONG, ids=lambda v: getattr(v, "__name__", "")
)
def test_a_wrong_type_is_refused_by_the_argument_s_name(
    function: Callable[..., Any], arguments: tuple[Any, ...], name: str
) -> None:
    with pytest.raises(ArgumentError, match=rf": {name} must be .*, not "):
        function(*arguments)


def test_a_path_of_a_wrong_type_is_refused(project: Project) -> None:
    functions: list[Callable[..., Any]] = [read_trace, replay, diagnose_trace]
    for function in functions:
        with pytest.raises(ArgumentError, match=r"path must be str or Path.*, not int"):
            function(project, 3)


def test_samples_in_place_of_a_chunk_are_refused_with_the_remedy(result: Replay) -> None:
    with pytest.raises(ArgumentError, match=r"chunk must be ndarray, not Samples; .*to_chunk"):
        fit_record(result.model, result.trace.samples)  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match=r"chunk must have the shape \(n, 9\)"):
        fit_record(result.model, result.chunk[:, :-1])
    with pytest.raises(ArgumentError, match="update: samples must be Samples, not ndarray"):
        Estimator(result.model).update(result.chunk)  # type: ignore[arg-type]


def test_samples_without_a_flag_teach_nothing_and_say_so(result: Replay) -> None:
    told = result.trace.samples
    bare = Samples(told.names, told.t_us, told.values, np.zeros_like(told.flags))
    with pytest.warns(UserWarning, match="none of 1500 samples has the flag ROW"):
        Estimator(result.model).update(bare)
    chunk = result.chunk.copy()
    chunk[:, 1] = 0.0
    with pytest.warns(UserWarning, match="nothing is learned; set it where the position"):
        fit_record(result.model, chunk)


def test_texts_serve_as_well_as_paths(
    project: Project, trace: Path, result: Replay, tmp_path: Path
) -> None:
    by_path = read_trace(project, trace)
    assert np.array_equal(by_path.samples.values, result.trace.samples.values)
    assert np.array_equal(read_trace(project, str(trace)).samples.t_us, by_path.samples.t_us)
    flowmap = publish(result.fit.solution)
    write_map(str(tmp_path / "map.json"), flowmap, {})
    again = read_map(str(tmp_path / "map.json"))[0]
    assert np.array_equal(again.edges[0].theta, flowmap.edges[0].theta)
    save(str(tmp_path / "s.npz"), result.live, project.digest)
    restored = load_snapshot(str(tmp_path / "s.npz"), project.model, project.digest)
    assert np.array_equal(restored.solution().unknowns, result.live.solution().unknowns)
    assert history(str(trace.with_suffix(".toml"))) == []
