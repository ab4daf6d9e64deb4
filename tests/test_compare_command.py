"""`rtid compare` and `rtid export` on a simulated trace, from the command line to the files."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from firmware_bridge.sources import read_table
from rtid.cli.compare import compare
from rtid.cli.export import export
from rtid.cli.simulate import simulate
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.maps.files import read_map
from rtid.project import load
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.reading import read_trace
from rtid.trace.snapshot import save
from tests.command import output_of
from tests.replays import shared_replays  # noqa: F401

APP = typer.Typer()
for command in (compare, export, simulate):
    APP.command()(command)


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 s of the simulated machine: 8 s to learn from, 4 s to judge by."""
    path = tmp_path_factory.mktemp("compare") / "run.log"
    output_of(APP, "simulate", path, "--duration", 12, "--motion", "rich", "--seed", 1)
    project = path.with_suffix(".toml")
    text = project.read_text()
    parts = "[record]\nidentification_s = [0, 8]\nvalidation_s = [8, 12]\n"
    project.write_text(text.partition("[record]")[0] + parts)
    return path


@pytest.fixture
def sheet(tmp_path: Path) -> Path:
    """The true gains, 10 % too large."""
    plant, w = SimulatedPlant(), np.arange(0.0, 10.05, 0.1)
    gains = [1.1 * plant.flow(edge, w, 4e6) / 2e3 for edge in plant.edges]
    path = tmp_path / "sheet.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["abs_u_V", *(f"K_{edge.upper()}" for edge in plant.edges)])
        writer.writerows(np.column_stack([w, *gains]).tolist())
    return path


def test_compare_answers_the_first_question(trace: Path, sheet: Path) -> None:
    text = output_of(
        APP, "compare", trace, "-p", trace.with_suffix(".toml"), "--map", sheet, "--json"
    )
    found = json.loads(text)
    own, other = found["maps"]
    assert [own["name"], other["name"]] == ["learned", "sheet"]
    for part in ("identification", "validation"):
        learned = own["parts"][part]["residual_share_of_rms_flow"]
        given = other["parts"][part]["residual_share_of_rms_flow"]
        assert max(learned) < 0.02
        assert min(given) > 0.04
    assert own["beta_pa"] == pytest.approx([SimulatedPlant().beta_pa] * 2, rel=0.03)
    assert {d["edge"] for d in found["differences"]} == {"pa", "at", "pb", "bt"}
    assert len(found["blocks"]) > 50


@pytest.mark.long
def test_compare_in_words_and_pictures(trace: Path, sheet: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    project = trace.with_suffix(".toml")
    text = output_of(APP, "compare", trace, "-p", project, "--map", sheet, "--pictures", folder)
    assert "With the learned map" in text
    assert "With the sheet map" in text
    assert "Learned minus sheet" in text
    assert "Simulated pressure: fit in %" in text
    names = {path.stem for path in folder.iterdir()}
    for one in ("learned", "sheet"):
        of_map = ("residual", "pressure", "cusum", "dependence", "correlation")
        assert names >= {f"{what}_{one}" for what in of_map}
    assert names >= {"where_identification", "where_validation", "maps", "slices"}


@pytest.fixture(scope="module")
def coarse(trace: Path) -> Path:
    """The same machine on a grid whose blocks are too large for its maps."""
    path = trace.with_name("coarse.toml")
    text = trace.with_suffix(".toml").read_text()
    wide, count = re.subn(r"(?m)^u_grid_v = .*$", "u_grid_v = [1.0, 4.0, 10.0]", text)
    assert count == 4
    path.write_text(wide)
    return path


@pytest.fixture(scope="module")
def later(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another record of the same machine."""
    path = tmp_path_factory.mktemp("later") / "later.log"
    output_of(APP, "simulate", path, "--duration", 12, "--motion", "rich", "--seed", 2)
    return path


@pytest.mark.long
@pytest.mark.slow
def test_two_projects_on_one_trace(trace: Path, coarse: Path, tmp_path: Path) -> None:
    arguments = ("compare", trace, "-p", trace.with_suffix(".toml"), "--against", coarse)
    text = output_of(APP, *arguments, "--pictures", tmp_path)
    assert "With the run map" in text
    assert "With the coarse map" in text
    assert "run explains the validation part better than coarse" in text
    assert "Run minus coarse" in text
    names = {path.stem for path in tmp_path.iterdir()}
    assert names >= {"beside", "pressure_run", "pressure_coarse", "where_validation_coarse"}


def test_two_traces_with_one_project(trace: Path, later: Path) -> None:
    arguments = ("compare", trace, "-p", trace.with_suffix(".toml"), "--against", later)
    found = json.loads(output_of(APP, *arguments, "--json"))
    names = [found["maps"][0]["name"], found["against"]["maps"][0]["name"]]
    assert names == ["run", "later"]
    changes = {d["edge"]: d for d in found["changes"]}
    assert set(changes) == {"pa", "at", "pb", "bt"}
    pa = changes["pa"]
    both = [
        abs(a - b) / 4e-4
        for a, b, status in zip(pa["flow_m3s"], pa["reference_m3s"], pa["status"], strict=True)
        if status == "valid" and b is not None
    ]
    assert len(both) > 5
    assert np.median(both) < 0.02


def test_two_reference_maps(trace: Path, sheet: Path, tmp_path: Path) -> None:
    exported = tmp_path / "before.json"
    project = trace.with_suffix(".toml")
    output_of(APP, "export", trace, exported, "-p", project)
    arguments = ("compare", trace, "-p", project, "--map", sheet, "--map", exported)
    found = json.loads(output_of(APP, *arguments, "--json"))
    names = [one["name"] for one in found["maps"]]
    assert names == ["learned", "sheet", "before"]
    assert set(found["differences_by_map"]) == {"sheet", "before"}
    wrong, before = (one["parts"]["validation"] for one in found["maps"][1:])
    own = found["maps"][0]["parts"]["validation"]
    assert max(before["residual_share_of_rms_flow"]) < 2 * max(own["residual_share_of_rms_flow"])
    fits = [p["simulations"]["free run"]["fit_percent"][0] for p in (own, before, wrong)]
    assert fits[2] < fits[1] <= fits[0] + 5


def test_from_a_block_to_its_spans_and_back(trace: Path) -> None:
    arguments = ("compare", trace, "-p", trace.with_suffix(".toml"))
    rows = json.loads(output_of(APP, *arguments, "--json"))["blocks"]
    row = max(rows, key=lambda r: r["dwell_s"])
    place = f"{row['edge']}:{row['i']},{row['j']}"
    spans = json.loads(output_of(APP, *arguments, "--block", place, "--json"))["spans_of_block"]
    assert len(spans) > 3
    t0, t1 = spans[len(spans) // 2]
    found = json.loads(output_of(APP, *arguments, "--span", f"{t0}:{t1}", "--json"))[
        "blocks_in_span"
    ]
    assert [row["edge"], row["i"], row["j"]] in [[v["edge"], v["i"], v["j"]] for v in found]
    text = output_of(APP, *arguments, "--block", place, "--span", f"{t0}:{t1}")
    assert f"Block {place} was visited {len(spans)} times" in text
    assert "Equation residual" not in text


@pytest.mark.parametrize(
    "option", [("--block", "pa:3"), ("--block", "3,4"), ("--span", "5"), ("--span", "9:8")]
)
def test_a_place_that_is_none_is_refused(trace: Path, option: tuple[str, str]) -> None:
    arguments = ["compare", str(trace), "-p", str(trace.with_suffix(".toml")), *option]
    result = CliRunner().invoke(APP, arguments)
    assert result.exit_code == 2


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_residuals_leave_as_a_table(trace: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"residual{suffix}"
    output_of(APP, "compare", trace, "-p", trace.with_suffix(".toml"), "--table", path)
    columns = read_table(path).columns
    t, residual = columns["t_s"], columns["residual_a_m3s"]
    assert len(t) == pytest.approx(12 * 50, abs=20)
    np.testing.assert_allclose(
        residual, columns["measured_a_m3s"] - columns["modelled_a_m3s"], atol=1e-12
    )
    assert np.abs(columns["p_a_measured_pa"] - columns["p_a_free_run_pa"]).max() < 2e6
    assert {"block_pa_u", "block_pa_dp", "u_v", "p_a_0_1_s_ahead_pa"} <= set(columns)


def test_a_table_of_no_known_format_is_refused_before_any_work(trace: Path) -> None:
    with pytest.raises(RtidError, match="unknown format") as caught:
        output_of(APP, "compare", trace, "-p", "absent.toml", "--table", "residual.xls")
    assert caught.value.exit_code == 2


def test_every_figure_is_in_the_json(trace: Path) -> None:
    found = json.loads(output_of(APP, "compare", trace, "-p", trace.with_suffix(".toml"), "--json"))
    assert found["schema"] == 2
    for part in found["maps"][0]["parts"].values():
        assert set(part["simulations"]) == {"free run", "1 s ahead", "0.1 s ahead"}
        run = part["simulations"]["free run"]
        assert set(run["stops"]) == {"gap", "off_grid", "ran_away"}
        assert len(run["fit_percent"]) == 2
        assert {d["signal"] for d in part["residual_against"]} >= {"u", "p_a", "x"}
        assert part["residual_by_direction"]["rows"]
        assert part["residual_over_time"]["mean_m3s"]
        assert {c["signal"] for c in part["correlations"]} >= {"", "u"}
        assert [c["chamber"] for c in part["cusum"]] == ["a", "b"]
    assert {"residual_share", "reason", "condition"} <= set(found["blocks"][0])


@pytest.mark.parametrize("suffix", [".csv", ".json", ".npz"])
def test_export_from_a_trace(trace: Path, tmp_path: Path, suffix: str) -> None:
    output = tmp_path / f"map{suffix}"
    text = output_of(APP, "export", trace, output, "-p", trace.with_suffix(".toml"), "--json")
    assert json.loads(text)["valid_blocks"]["pa"] > 5
    assert output.stat().st_size > 1000


def test_export_from_a_snapshot_is_what_the_daemon_knows(trace: Path, tmp_path: Path) -> None:
    project = load(trace.with_suffix(".toml"))
    live = Estimator(project.model)
    live.update(read_trace(project, trace).samples)
    save(tmp_path / "snapshot.npz", live, project.digest)
    output = tmp_path / "map.json"
    output_of(APP, "export", tmp_path / "snapshot.npz", output, "-p", trace.with_suffix(".toml"))
    _, provenance = read_map(output)
    assert provenance["beta_pa"] == live.solution().beta_pa.tolist()
    assert provenance["digest"] == project.digest


def test_export_names_the_formats_before_it_works(trace: Path, tmp_path: Path) -> None:
    with pytest.raises(RtidError, match="unknown format") as caught:
        output_of(APP, "export", trace, tmp_path / "map.xls", "-p", tmp_path / "absent.toml")
    assert caught.value.exit_code == 2
