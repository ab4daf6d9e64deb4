"""Holding maps against traces: residuals, refitted bulk modulus, data sheets, tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtid.compare import ReferenceMap, block_rows, compare, deviations, learned, refitted
from rtid.compare.reference import GainTable, MissingEdgeError
from rtid.estimator.chunk import to_chunk
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.estimator.record import RecordFit, fit_record
from rtid.maps.datasheet import DataSheetError, read_reference
from rtid.model import Grid, Lag, Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.run import Run, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.replays import shared_replays  # noqa: F401

GRID = Grid(
    np.concatenate([np.arange(1.0, 4.0, 0.25), np.arange(4.0, 10.1, 0.5)]),
    np.concatenate([[-0.5, 0.0, 0.25, 0.5, 1.0], np.arange(1.75, 9.5, 0.75)]) * 1e6,
)
Learned = tuple[Machine, RecordFit, FlowMap, FloatArray, Run]


@pytest.fixture(scope="module")
def machine() -> Learned:
    """A simulated machine, learned on 14 s, with 6 s that the fit has not seen."""
    run = simulate(SimulatedPlant(), "rich", seed=3, duration_s=20.0)
    model = declared_model(run.plant, grid=GRID, lag=Lag(1.3e-3, 0.0))
    chunk = to_chunk(model, run.samples, 0)
    fit = fit_record(model, chunk[:14000])
    return model, fit, publish(fit.solution), chunk, run


def truth_table(plant: SimulatedPlant, share: float = 1.0) -> ReferenceMap:
    """The true maps as a data sheet, every gain times `share`."""
    w = np.arange(0.0, 10.01, 0.02)
    tables = {}
    for edge in plant.edges:
        gain = plant.flow(edge, w, 4e6) / np.sqrt(4e6)
        tables[edge] = GainTable(w, np.ones(1), share * gain[:, None])
    return ReferenceMap("sheet", tables)


def test_learned_map_explains_what_the_fit_has_not_seen(machine: Learned) -> None:
    model, fit, flowmap, chunk, _ = machine
    seen = compare(model, learned(fit, flowmap), chunk[:14000])
    new = compare(model, learned(fit, flowmap), chunk[14000:])
    assert (seen.residual_share < 0.005).all()
    assert (new.residual_share < 0.01).all()
    assert (seen.rho < 1.5).all()
    assert len(seen.t_s) == pytest.approx(14 * 50, abs=10)
    assert sum(new.shares.values()) == pytest.approx(1.0)
    assert seen.shares["extrapolated"] == 0.0
    assert new.shares["extrapolated"] > 0.0
    still = replace(new, measured_m3s=np.zeros_like(new.measured_m3s))
    with np.errstate(all="raise"):
        assert np.isnan(still.residual_share).all()


def test_comparison_needs_no_whole_second(machine: Learned) -> None:
    model, fit, flowmap, chunk, _ = machine
    for n in (0, 1, 50):
        part = compare(model, learned(fit, flowmap), chunk[:n])
        assert part.t_s.shape == (0,)
        assert part.residual_m3s.shape == (0, 2)


def test_the_true_map_gets_the_true_bulk_modulus(machine: Learned) -> None:
    model, fit, _, chunk, run = machine
    candidate = refitted(model, truth_table(run.plant), fit.weights, chunk)
    np.testing.assert_allclose(1 / candidate.compliance, run.plant.beta_pa, rtol=0.01)
    assert (compare(model, candidate, chunk).residual_share < 0.01).all()


def test_a_wrong_data_sheet_shows_in_the_residual(machine: Learned) -> None:
    model, fit, flowmap, chunk, run = machine
    sheet = refitted(model, truth_table(run.plant, 1.1), fit.weights, chunk)
    wrong, right = compare(model, sheet, chunk), compare(model, learned(fit, flowmap), chunk)
    assert (wrong.residual_share > 0.05).all()
    assert (wrong.residual_share > 10 * right.residual_share).all()
    assert wrong.shares["reference"] > 0.9


def test_block_rows_place_the_residual(machine: Learned) -> None:
    model, fit, flowmap, chunk, _ = machine
    rows = block_rows(fit.solution, compare(model, learned(fit, flowmap), chunk[:14000]))
    assert len(rows) == len(fit.solution.blocks)
    known = [row for row in rows if np.isfinite(row.residual_rms_m3s)]
    assert len(known) > 50
    assert all(row.reason for row in rows if row.status != "valid")
    busiest = max(rows, key=lambda row: row.dwell_s)
    assert busiest.residual_rms_m3s < 0.01 * busiest.flow_m3s


def test_residual_of_a_wrong_edge_stays_in_its_blocks(machine: Learned) -> None:
    model, fit, flowmap, chunk, _ = machine
    bent = replace(flowmap.edges[0], theta=1.05 * flowmap.edges[0].theta)
    wrong = FlowMap((bent, *flowmap.edges[1:]))
    rows = block_rows(fit.solution, compare(model, learned(fit, wrong), chunk[:14000]))
    by_edge = {e.name: [r for r in rows if r.edge == e.name] for e in model.edges}
    medians = {n: np.nanmedian([r.residual_rms_m3s for r in rs]) for n, rs in by_edge.items()}
    assert medians["pa"] > 5 * medians["at"]
    assert medians["pa"] > 5 * medians["pb"]


def test_intervals_of_extrapolated_cells_are_honest(machine: Learned) -> None:
    _, _, flowmap, _, run = machine
    z = []
    for d in deviations(flowmap, truth_table(run.plant)):
        away = (d.status == "extrapolated") & np.isfinite(d.reference_m3s) & (d.dp_pa > 2e5)
        z.append(((d.flow_m3s - d.reference_m3s) / d.sd_m3s)[away])
    every = np.concatenate(z)
    assert len(every) > 500
    assert np.mean(np.abs(every) < 2) > 0.9
    assert np.sqrt(np.mean(every**2)) < 1.5


def test_deviations_from_the_truth_are_small_where_valid(machine: Learned) -> None:
    _, _, flowmap, _, run = machine
    for d in deviations(flowmap, truth_table(run.plant)):
        assert d.valid.sum() > 20
        assert np.abs(d.share_of_largest[d.valid]).max() < 0.02


def test_reference_knows_only_its_range_and_is_sign_symmetric(machine: Learned) -> None:
    sheet = truth_table(SimulatedPlant())
    assert np.isnan(sheet.flow("pa", [-1.0, 11.0], 4e6)).all()
    assert sheet.flow("pa", 4.0, -2e6) == -sheet.flow("pa", 4.0, 2e6)
    with pytest.raises(MissingEdgeError, match="'cross'"):
        sheet.flow("cross", 4.0, 1e6)
    assert sheet.theta_cells(machine[0]).shape[1] == 6


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_one_gain_column_serves_every_edge(tmp_path: Path) -> None:
    sheet = read_reference(write(tmp_path / "m.csv", "abs_u_V,K\n0,0\n2,0\n4,1e-7\n"))
    assert sheet.name == "m"
    assert sheet.flow("any", 3.0, 4e6) == pytest.approx(0.5e-7 * 2e3)


def test_gain_columns_per_edge_and_other_units(tmp_path: Path) -> None:
    sheet = read_reference(write(tmp_path / "m.csv", "abs_u_mV,K_PA,K_AT\n0,0,0\n2000,2e-7,1e-7\n"))
    assert sheet.flow("pa", 1.0, 1e6) == pytest.approx(1e-4)
    assert sheet.flow("AT", 1.0, 1e6) == pytest.approx(0.5e-4)


def test_long_form_with_missing_flows(shared: Path) -> None:
    table = read_reference(shared / "data" / "paper_table1.csv")
    assert table.flow("x", 6.0, 4.5e6) * 6e4 == pytest.approx(17.57)
    assert table.flow("x", 5.5, 5.0e6) * 6e4 == pytest.approx(0.5 * (12.22 + 17.18))
    assert np.isnan(table.flow("x", 3.9, 5e6))


def test_long_form_per_edge(tmp_path: Path) -> None:
    text = "edge,dp_bar,u_V,Q_l_min\na,10,1,6\na,10,2,12\nb,10,1,3\nb,10,2,NA\nb,20,2,6\n"
    sheet = read_reference(write(tmp_path / "m.csv", text))
    assert sheet.flow("a", 1.5, 1e6) * 6e4 == pytest.approx(9.0)
    assert sheet.flow("b", 2.0, 2e6) * 6e4 == pytest.approx(6.0)
    titles = text.replace("edge,dp_bar,u_V,Q_l_min", "Valve,dp [bar],u [V],flow [L/min]")
    other = read_reference(write(tmp_path / "stranger.csv", titles))
    assert other.flow("a", 1.5, 1e6) == sheet.flow("a", 1.5, 1e6)
    assert other.flow("b", 1.0, 1e6) * 6e4 == pytest.approx(3.0), "not those of a as well"


@pytest.mark.parametrize("text", [
    "u_V;dp_MPa;Q_l_min\n0,5;1,0;4,5\n1,5;1,0;NA\n1,5;2,0;12,5\n",
    "\ufeff# gemessen\nu;dp;Q\nV;MPa;l/min\n0,5;1;4,5\n\n1,5;2;12,5\n",
    "Prüfblatt\n\nu_V\tdp_MPa\tQ_l_min\n0.5\t1\t4.5\n# Mitte\n1.5\t2\t12.5\n",
])  # fmt: skip
@pytest.mark.parametrize("code", ["utf-8", "cp1252", "utf-16"])
def test_a_sheet_of_a_german_spreadsheet(tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / "m.csv"
    path.write_bytes(text.removeprefix("\ufeff" if code == "cp1252" else "").encode(code))
    sheet = read_reference(path)
    assert sheet.flow("x", 0.5, 1e6) * 6e4 == pytest.approx(4.5)
    assert sheet.flow("x", 1.5, 2e6) * 6e4 == pytest.approx(12.5)


def test_a_first_row_of_numbers_that_are_missing_is_no_row_of_units(tmp_path: Path) -> None:
    text = "abs_u_V,K_PA,K_AT\n0,NA,NA\n2,2e-7,1e-7\n3,2e-7,1e-7\n"
    sheet = read_reference(write(tmp_path / "m.csv", text))
    assert np.isnan(sheet.flow("pa", 1.0, 1e6)) and sheet.flow("at", 2.5, 1e6) > 0.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no data"),
        ("abs_u_V,K\n", "no data"),
        ("abs_u_V,K\n1,2\n3\n", "data line 3 has 1 of 2 columns"),
        ("abs_u_V,K\n1,2\nx,3\n", "line 3, column 'abs_u_V': 'x' is no number"),
        ("abs_u_V,K\n1,2\n1,3\n", "only once"),
        ("abs_u_MPa,K\n1,2\n2,3\n", "is no command"),
        ("abs_u,K\n1,2\n2,3\n", "names no unit"),
        ("u_V,Q_l_min\n1,2\n2,3\n", "no single column dp_UNIT"),
        ("u_V,dp_MPa,Q_l_min\n1,1,2\n1,2,3\n", "one command only"),
    ],
)
def test_a_broken_data_sheet_is_refused_by_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataSheetError, match=message):
        read_reference(write(tmp_path / "sheet.csv", text))


def test_binary_junk_is_no_data_sheet(tmp_path: Path) -> None:
    path = tmp_path / "junk.csv"
    path.write_bytes(bytes(range(256)) * 20)
    with pytest.raises(DataSheetError):
        read_reference(path)
