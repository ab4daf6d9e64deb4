"""`rtid compare` and `rtid export` on a simulated trace, from the command line to the files."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from rtid.cli.compare import compare
from rtid.cli.export import export
from rtid.cli.simulate import simulate
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.mapfiles import read_map
from rtid.project import load
from rtid.replay import read_trace
from rtid.sim.plant import Plant
from rtid.store import save

APP = typer.Typer()
for command in (compare, export, simulate):
    APP.command()(command)


def call(*arguments: object) -> str:
    result = CliRunner().invoke(APP, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 s of the simulated machine: 8 s to learn from, 4 s to judge by."""
    path = tmp_path_factory.mktemp("compare") / "run.log"
    call("simulate", path, "--duration", 12, "--motion", "rich", "--seed", 1)
    project = path.with_suffix(".toml")
    text = project.read_text()
    parts = "[record]\nidentification_s = [0, 8]\nvalidation_s = [8, 12]\n"
    project.write_text(text.partition("[record]")[0] + parts)
    return path


@pytest.fixture
def sheet(tmp_path: Path) -> Path:
    """The true gains, 10 % too large."""
    plant, w = Plant(), np.arange(0.0, 10.05, 0.1)
    gains = [1.1 * plant.flow(edge, w, 4e6) / 2e3 for edge in plant.edges]
    path = tmp_path / "sheet.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["abs_u_V", *(f"K_{edge.upper()}" for edge in plant.edges)])
        writer.writerows(np.column_stack([w, *gains]).tolist())
    return path


def test_compare_answers_the_first_question(trace: Path, sheet: Path) -> None:
    text = call("compare", trace, "-p", trace.with_suffix(".toml"), "--map", sheet, "--json")
    found = json.loads(text)
    own, other = found["maps"]
    assert [own["name"], other["name"]] == ["learned", "sheet"]
    for part in ("identification", "validation"):
        learned = own["parts"][part]["residual_share_of_rms_flow"]
        given = other["parts"][part]["residual_share_of_rms_flow"]
        assert max(learned) < 0.02
        assert min(given) > 0.04
    assert own["beta_pa"] == pytest.approx([Plant().beta_pa] * 2, rel=0.03)
    assert {d["edge"] for d in found["differences"]} == {"pa", "at", "pb", "bt"}
    assert len(found["blocks"]) > 50


def test_compare_in_words_and_pictures(trace: Path, sheet: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    project = trace.with_suffix(".toml")
    text = call("compare", trace, "-p", project, "--map", sheet, "--pictures", folder)
    assert "With the learned map" in text
    assert "With the sheet map" in text
    assert "Learned minus sheet" in text
    assert "Simulated pressure: fit in %" in text
    names = {path.stem for path in folder.iterdir()}
    for one in ("learned", "sheet"):
        of_map = ("residual", "pressure", "cusum", "dependence", "correlation")
        assert names >= {f"{what}_{one}" for what in of_map}
    assert names >= {"where_identification", "where_validation", "maps", "slices"}


@pytest.mark.parametrize("suffix", [".csv", ".json", ".npz"])
def test_export_from_a_trace(trace: Path, tmp_path: Path, suffix: str) -> None:
    output = tmp_path / f"map{suffix}"
    text = call("export", trace, output, "-p", trace.with_suffix(".toml"), "--json")
    assert json.loads(text)["valid_blocks"]["pa"] > 5
    assert output.stat().st_size > 1000


def test_export_from_a_snapshot_is_what_the_daemon_knows(trace: Path, tmp_path: Path) -> None:
    project = load(trace.with_suffix(".toml"))
    live = Estimator(project.model)
    live.update(read_trace(project, trace).samples)
    save(tmp_path / "snapshot.npz", live, project.digest)
    output = tmp_path / "map.json"
    call("export", tmp_path / "snapshot.npz", output, "-p", trace.with_suffix(".toml"))
    _, provenance = read_map(output)
    assert provenance["beta_pa"] == live.solution().beta_pa.tolist()
    assert provenance["digest"] == project.digest


def test_export_names_the_formats_before_it_works(trace: Path, tmp_path: Path) -> None:
    with pytest.raises(RtidError, match="unknown format") as caught:
        call("export", trace, tmp_path / "map.xls", "-p", tmp_path / "absent.toml")
    assert caught.value.exit_code == 2
