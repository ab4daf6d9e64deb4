"""The rig's baseline run: learned on 0..80 s, judged by the calibrated maps and on 83..110 s."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtid.compare import FREE_RUN, PAPER_DP_PA, PAPER_U_V, ReferenceMap, deviations
from rtid.estimator.flowmap import VALID
from rtid.maps.datasheet import read_reference
from rtid.project import load
from rtid.study.compared import TraceComparison, compare_trace, study
from rtid.study.replay import replay
from rtid.study.revisions import add
from tests.replays import shared_replays  # noqa: F401
from tests.rig import figures

PROJECT = Path(__file__).parents[1] / "rtid" / "project" / "examples" / "cylinder.toml"

# It was -72 % with moduli of 570 and 562 MPa beside the delay; they are 557 and 442 now, for 700.
NO_WORSE = pytest.mark.xfail(strict=True, reason="53 and 66 % beside a delay of 30 ms")


@pytest.fixture(scope="module")
def calibrated(shared: Path) -> ReferenceMap:
    return read_reference(shared / "data" / "rig" / "truth" / "valve_maps_calibrated.csv")


@pytest.fixture(scope="module")
def comparison(shared: Path, calibrated: ReferenceMap) -> TraceComparison:
    run = shared / "data" / "rig" / "measured" / "rig_01.parquet"
    return compare_trace(replay(load(PROJECT), run), calibrated)


def test_validation_residual_is_below_0_7_percent_of_the_flow(comparison: TraceComparison) -> None:
    part = comparison.held[0].parts["validation"]
    assert (part.residual_share < 0.007).all()
    assert 0.05 < part.shares["extrapolated"] < 0.5
    assert part.shares["outside"] < 0.01


def test_nodes_inside_the_data(comparison: TraceComparison, calibrated: ReferenceMap) -> None:
    """Mean error at most 0.5 %, largest 1.5 % of the largest flow."""
    errors = []
    for edge in comparison.flowmap.edges:
        s = edge.status == VALID
        i, j = np.nonzero(s[1:, 1:] & s[:-1, 1:] & s[1:, :-1] & s[:-1, :-1])
        w, dp = edge.grid.u_v[i + 1], edge.grid.dp_pa[j + 1]
        truth = calibrated.flow(edge.name, w, dp)
        errors.append(np.abs(edge.flow(w, dp) - truth) / edge.q_max_m3s)
        assert len(w) > 10
    every = np.concatenate(errors)
    assert every.mean() < 0.005
    assert every.max() < 0.015


def test_table_1_of_the_paper_and_its_figures(
    comparison: TraceComparison, calibrated: ReferenceMap
) -> None:
    """The paper reached 2.2 % mean and 8.4 % at worst, where it had data."""
    for d in deviations(comparison.flowmap, calibrated, PAPER_U_V, PAPER_DP_PA):
        share = np.abs(d.share)
        assert share.mean() < 0.022
        assert share.max() < 0.084


def test_the_manufacturers_sheet_is_told_apart_from_the_calibration(
    comparison: TraceComparison, shared: Path
) -> None:
    learned, calibrated = comparison.held
    sheet = read_reference(shared / "data" / "rig" / "nominal" / "valve_map_manufacturer.csv")
    wrong = compare_trace(comparison.replay, sheet).held[1].parts["validation"].residual_share
    assert (calibrated.parts["validation"].residual_share < 0.005).all()
    assert (wrong > 20 * learned.parts["validation"].residual_share).all()


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("number", ["05", "08"])
def test_with_the_missing_effect_added_maps_and_free_run_are_those_of_a_sound_machine(
    shared: Path, calibrated: ReferenceMap, tmp_path: Path, number: str
) -> None:
    """A leak (05) and a delay (08): maps 0.02 to 0.06 % off, 1 to 5 % without; beta of 700 MPa.

    The free run on unseen motion fits to 97 %.
    """
    project, run = (
        tmp_path / "rig.toml",
        shared / "data" / "rig" / "measured" / f"rig_{number}.parquet",
    )
    project.write_text(PROJECT.read_text())
    before = study(replay(load(project), run))
    add(project, run)
    after = study(replay(load(project), run))
    for edge in figures(after.replay, calibrated):
        assert len(edge.nodes) > 10
        assert edge.nodes.mean() < 0.001 and edge.nodes.max() < 0.003
    np.testing.assert_allclose(after.held[0].beta_pa, 700e6, rtol=0.01)
    old, new = (found.held[0].examinations["validation"] for found in (before, after))
    assert (new.equation.residual_share < 0.005).all()
    assert (old.equation.residual_share > 0.02).all()
    assert (new.simulations[FREE_RUN].fit_percent > 95.0).all()


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("number", ["05", pytest.param("08", marks=NO_WORSE)])
def test_without_the_effect_a_free_run_is_worse_than_a_constant(shared: Path, number: str) -> None:
    """-202 % at worst beside a leak that nobody has told the model of."""
    run = shared / "data" / "rig" / "measured" / f"rig_{number}.parquet"
    examined = study(replay(load(PROJECT), run)).held[0].examinations["validation"]
    assert examined.simulations[FREE_RUN].fit_percent.min() < 0.0
