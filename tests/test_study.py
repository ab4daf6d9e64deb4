"""One record under one project is one object: one fit for every command, page and arrays."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtid
from firmware_bridge.samples import Samples
from rtid.diagnose.excuse import steady
from rtid.errors import ArgumentError
from rtid.maps.files import read_map
from rtid.project import load
from rtid.sim.hidden import hide_wish
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study import kept
from rtid.study import study as studies
from rtid.study.packed import PackError, packed, unpacked
from rtid.study.revisions import add
from rtid.study.seed import CLASSES
from rtid.study.study import Study
from rtid.tell.arrays import ArrayStudy
from rtid.ui.desk import Desk
from tests.command import in_json
from tests.replays import shared_replays  # noqa: F401

DURATION_S = 25.0
LEAK = "internal_leakage_laminar", "a-b"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean record and one with a leak, and their projects."""
    path = tmp_path_factory.mktemp("study")
    for name, plant in (
        ("clean", SimulatedPlant()),
        ("leak", hide_wish(SimulatedPlant(), f"{LEAK[0]}=middle")),
    ):
        write_run(path / f"{name}.parquet", simulate(plant, "rich", 1, DURATION_S), 1, "rich")
    return path


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(kept.PLACE, raising=False)
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("user")))
        kept._secret.cache_clear()
        yield
    kept._secret.cache_clear()


def files_of(folder: Path) -> list[Path]:
    return sorted((folder / kept.FOLDER).glob(f"*{kept.SUFFIX}"))


def test_one_beta_and_one_rho_in_every_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace, project = folder / "clean.parquet", folder / "clean.toml"
    diagnosis = in_json("diagnose", trace, "-p", project)
    replay = in_json("replay", trace, "-p", project)
    monkeypatch.setattr(studies, "fitted", None)  # from here on all is kept: nothing is fitted
    monkeypatch.setattr(studies, "replayed", None)
    monkeypatch.setattr(studies, "searched", None)
    compare = in_json("compare", trace, "-p", project)
    with monkeypatch.context() as blind:
        blind.setattr(studies, "read_trace", None)  # the maps are kept: the record is not read
        in_json("export", trace, folder / "map.json", "-p", project)
    origin = read_map(folder / "map.json")[1]
    again = in_json("diagnose", trace, "-p", project)
    learned = in_json("check", project, trace)["learned"]

    assert again == diagnosis and diagnosis["verdict"] == "matches"
    beta = list(replay["beta_pa"].values())
    assert beta == pytest.approx(diagnosis["beta_pa"], rel=1e-9)
    assert origin["beta_pa"] == beta
    spread = list(replay["beta_sd_pa"].values())
    assert origin["beta_sd_pa"] == spread
    assert spread == pytest.approx(
        diagnosis["beta_sd_pa"], rel=0.25
    )  # clusters of blocks: each is one draw
    rhos = {diagnosis["rho_before"], replay["rho"], compare["rho_of_fit"], origin["rho"]}
    assert len(rhos) == 1 and 0.9 < rhos.pop() < 1.1
    held = [maps["beta_pa"] for maps in compare["maps"] if maps["name"] == "learned"]
    assert held[0] == pytest.approx(beta, rel=1e-9)
    cells = {edge.name: int((edge.status == "valid").sum()) for edge in _edges(folder)}
    assert learned == cells
    assert np.abs(np.array(beta) / SimulatedPlant().beta_pa - 1).max() < 0.01


def _edges(folder: Path) -> Any:
    return read_map(folder / "map.json")[0].edges


def test_what_is_kept_may_be_deleted_damaged_or_foreign(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace, project = folder / "clean.parquet", folder / "clean.toml"

    def exported(*more: str) -> bytes:
        in_json("export", trace, folder / "again.json", "-p", project, *more)
        return (folder / "again.json").read_bytes()

    first = exported()
    whole = {path: path.read_bytes() for path in files_of(folder)}
    assert whole
    for path, content in whole.items():
        path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert exported() == first, "learned again, and the same"
    assert all(path.read_bytes() == whole[path] for path in whole if "record" in path.name)

    monkeypatch.setattr(kept, "_secret", lambda: b"of somebody else")
    read: list[object] = []
    with kept.keeping():
        place = kept.Kept.of(load(project), (trace,))
        assert place is not None
        read = [place.read(kind, classes) for kind, classes in CLASSES.items()]
    assert read == [None] * len(read)
    monkeypatch.undo()

    for path in files_of(folder):
        path.unlink()
    assert exported("--no-cache") == first
    assert not files_of(folder), "nothing is kept"
    Study(project, trace)._keep("fit", 1)
    assert not files_of(folder), "only commands keep anything"


def test_the_oldest_goes_and_a_folder_that_takes_nothing_is_left(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "MOST_BYTES", 30_000)
    place = kept.Kept("key", (tmp_path / "a",))
    for k in range(5):
        place.write(str(k), np.zeros(1000))
        os.utime(tmp_path / "a" / f"key-{k}.kept", (k, k))
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == [
        f"key-{k}.kept" for k in (2, 3, 4)
    ]
    (tmp_path / "file").write_text("no folder")
    other = kept.Kept("key", (tmp_path / "file" / "b", tmp_path / "c"))
    other.write("x", (1.5, None))
    assert other.read("x", ()) == (1.5, None)
    assert [p.name for p in (tmp_path / "c").iterdir()] == ["key-x.kept"]


def test_only_named_classes_are_made() -> None:
    machine, secret = load_model(), b"secret"
    content = packed({"a": machine.lag, ("b", 1): np.arange(3)}, secret)
    back = unpacked(content, secret, (type(machine.lag),))
    assert back["a"] == machine.lag and back["b", 1].tolist() == [0, 1, 2]
    with pytest.raises(PackError):
        unpacked(content, secret, ())
    with pytest.raises(PackError):
        unpacked(content, b"another", (type(machine.lag),))
    with pytest.raises(PackError):
        unpacked(content[:20], secret, (type(machine.lag),))


def load_model() -> Any:
    from rtid.sim.declare import declared_model

    return declared_model(SimulatedPlant())


@pytest.mark.long
def test_the_page_and_the_command_add_the_same(folder: Path) -> None:
    trace, project = folder / "leak.parquet", folder / "leak.toml"
    desk = Desk(lambda _text, _share: None)
    desk.open(project, trace, None)
    told = desk.diagnose().diagnosis
    assert (told.found[0].effect, told.found[0].where) == LEAK
    section = desk.add(*LEAK, "by name").section
    done = add(project, trace, *LEAK, dry_run=True).changes[0]
    page = section.model_dump(mode="json", exclude_none=True)
    assert page["parameters"] == done.section["parameters"]
    assert page["errors"] == done.section["errors"]
    added = rtid.Study(project, trace).add(dry_run=True).changes[0]
    assert added.section["parameters"] == page["parameters"], "named by the diagnosis: the same"


def test_a_missing_effect_is_no_excuse_and_bends_no_modulus(folder: Path) -> None:
    study = Study(folder / "leak.toml", folder / "leak.parquet")
    present = study.fitted
    assert present.rho > 20 and not present.weights.missed.any()
    off = 1.0 / present.compliance / SimulatedPlant().beta_pa - 1
    told = 1.0 / steady(present).compliance / SimulatedPlant().beta_pa - 1
    assert np.abs(told).mean() < 0.5 * np.abs(off).mean()
    solution = study.fit.solution
    assert solution.rho == present.rho
    z = (solution.beta_pa - SimulatedPlant().beta_pa) / solution.beta_sd_pa
    assert np.abs(z).max() < 4


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulate(SimulatedPlant(), "rich", 1, DURATION_S).samples


def arrays(samples: Samples) -> dict[str, Any]:
    names = {"u": "u", "p_a": "p_a", "p_b": "p_b", "p_s": "p_supply", "p_t": "p_tank", "x": "x"}
    t = 1e-6 * (samples.t_us - samples.t_us[0])
    return {"t": t} | {name: samples.column(signal) for name, signal in names.items()}


def test_arrays_are_a_record_without_a_file(folder: Path, samples: Samples) -> None:
    given = arrays(samples)
    study = rtid.fit(machine=folder / "clean.toml", **given)
    assert isinstance(study, ArrayStudy)
    assert study.diagnosis().verdict == "matches"
    assert study.fit.solution.beta_pa == pytest.approx(SimulatedPlant().beta_pa, rel=0.02)
    u, dp = 5.0, 4e6
    assert study.map["pa"].flow(u, dp) == pytest.approx(
        SimulatedPlant().flow("pa", u, dp), rel=0.01
    )
    assert len(study.plot().axes) == 4
    frame = study.to_pandas()
    assert {"part", "residual_a_m3s", "measured_b_m3s"} <= set(frame.columns) and len(frame) > 500


def test_a_gap_is_nan_and_a_machine_may_be_made_in_python(samples: Samples) -> None:
    given = arrays(samples)
    given["p_a"] = given["p_a"].copy()
    given["p_a"][3000:3100] = np.nan
    study = rtid.fit(machine=load_model(), **given)
    assert len(study.trace.samples) == len(given["t"]) - 100
    assert study.trace.samples.flags[3000] & 2
    assert study.fit.solution.beta_pa == pytest.approx(SimulatedPlant().beta_pa, rel=0.02)


def test_every_valve_may_have_a_column_of_its_own(samples: Samples) -> None:
    machine, given = load_model(), arrays(samples)
    edges = tuple(replace(e, command=f"u_{e.name}", direction=1) for e in machine.edges)
    commands = tuple(replace(machine.signals[0], name=e.command) for e in edges)
    apart = replace(machine, edges=edges, signals=(*commands, *machine.signals[1:]))
    with pytest.raises(ArgumentError, match=r"fit: u must have the shape \(25000, 4\)"):
        rtid.fit(machine=apart, **given)
    ways = np.array([edge.direction for edge in machine.edges])
    given["u"] = np.maximum(given["u"][:, None] * ways, 0.0)
    study = rtid.fit(machine=apart, **given)
    assert study.fit.solution.beta_pa == pytest.approx(SimulatedPlant().beta_pa, rel=0.02)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("t", lambda t: t[::-1], r"t must rise; t\[1\]"),
        ("t", lambda t: 1e3 * t, "t must be in s, its steps are 1"),
        ("p_a", lambda p: 1e-5 * p, "p_a must be in Pa, its largest is"),
        ("x", lambda x: 1e3 * x, "x must be in m, its largest is"),
        ("p_b", lambda p: p[:-1], r"p_b must have the shape \(25000,\) as t or one number"),
        ("u", lambda u: u[:, None], "u must have the shape"),
        ("p_s", lambda p: np.nan * p, "p_s must be in Pa"),
    ],
)
def test_a_wrong_array_is_refused_by_its_name(
    samples: Samples, name: str, change: Any, words: str
) -> None:
    given = arrays(samples)
    given[name] = change(given[name])
    with pytest.raises(ArgumentError, match=words):
        rtid.fit(machine=load_model(), **given)
