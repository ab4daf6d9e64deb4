"""Pictures: they show what is there, lose no spike, and come out the same each time."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure

from rtid.compare import Comparison, Intervals
from rtid.estimator.flowmap import VALID, FlowMap
from rtid.estimator.published import publish
from rtid.model import Model
from rtid.pictures import coverage, maps, residual, save, slices
from rtid.pictures.coverage import working_points
from rtid.pictures.style import thin
from tests.flow_maps import machine, orifice, solved


@pytest.fixture(scope="module")
def model() -> Model:
    return machine(edges=2)


@pytest.fixture(scope="module")
def flowmap(model: Model) -> FlowMap:
    return publish(solved(model, orifice, np.random.default_rng(0), rows=120))


def part(rows: int = 4000, spike: float = 0.0) -> Comparison:
    t_s = np.arange(rows) / 50.0
    measured = 2e-4 * np.sin(t_s)[:, None]
    modelled = measured.copy()
    if rows:
        modelled[rows // 3] -= spike
    cell = np.full((rows, 2), -1)
    inner = Intervals(
        np.arange(rows + 1) / 50.0,
        cell,
        np.zeros((rows, 1)),
        np.zeros((rows, 1)),
        np.zeros((rows, 4)),
    )
    shares, rho, signals = {"valid": 1.0}, np.ones(1), np.zeros((rows, 4))
    return Comparison("learned", t_s, measured, modelled, cell, shares, rho, signals, inner)


def chunk(n: int = 500) -> np.ndarray:
    rng = np.random.default_rng(0)
    columns = (rng.uniform(-5, 8, n), np.full(n, 7e6), rng.uniform(1e6, 6e6, n), np.full(n, 0.1))
    return np.column_stack([np.arange(n) * 1e-3, np.ones(n), *columns])


def drawings(model: Model, flowmap: FlowMap) -> dict[str, Figure]:
    return {
        "coverage": coverage(model, flowmap, chunk()),
        "maps": maps(flowmap),
        "slices": slices(flowmap, flowmap, reference_name="sheet"),
        "residual": residual(model, {"identification": part(), "validation": part(300)}),
    }


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_every_picture_is_written(
    model: Model, flowmap: FlowMap, tmp_path: Path, suffix: str
) -> None:
    heads = {".png": b"\x89PNG", ".svg": b"<?xml"}
    for name, figure in drawings(model, flowmap).items():
        path = save(figure, tmp_path / f"{name}{suffix}")
        assert path.read_bytes()[:5].startswith(heads[suffix])
        assert path.stat().st_size > 10_000


def test_same_map_same_bytes(flowmap: FlowMap, tmp_path: Path) -> None:
    one, two = (save(maps(flowmap), tmp_path / f"{k}.svg").read_bytes() for k in (1, 2))
    assert one == two


def test_everything_that_is_not_valid_is_hatched(flowmap: FlowMap) -> None:
    for axis, edge in zip(maps(flowmap).axes, flowmap.edges, strict=False):
        veils = [c for c in axis.collections if isinstance(c, PatchCollection)]
        assert [v.get_hatch() for v in veils] == ["////"]
        assert len(veils[0].get_paths()) == (edge.status != VALID).sum()


def test_slices_show_the_reference_as_dots(flowmap: FlowMap) -> None:
    axis = slices(flowmap, flowmap, u_v=[3.0, 5.0]).axes[0]
    dots = [line for line in axis.lines if line.get_marker() == "o"]
    assert len(dots) == 2
    dp = np.asarray(dots[1].get_xdata(), float) * 1e6
    q_lpm = np.asarray(dots[1].get_ydata(), float)
    np.testing.assert_allclose(q_lpm, flowmap.flow("e0", 5.0, dp) * 6e4)


def test_a_spike_of_one_row_is_drawn(model: Model) -> None:
    figure = residual(model, {"all": part(40_000, spike=1e-4)})
    lowest = max(np.nanmax(np.asarray(line.get_ydata(), float)) for line in figure.axes[1].lines)
    assert lowest == pytest.approx(6.0)


def test_a_part_without_rows_is_an_empty_panel(model: Model, tmp_path: Path) -> None:
    save(residual(model, {"identification": part(), "validation": part(0)}), tmp_path / "r.png")


def test_thinning_keeps_extremes_order_and_ends() -> None:
    t = np.arange(10_007.0)
    y = np.sin(t / 300)
    y[5001] = 9.0
    kept_t, kept = thin(t, y, bins=100)
    assert len(kept) <= 202
    assert (np.diff(kept_t) > 0).all()
    assert kept.max() == 9.0
    assert kept.min() == y.min()
    assert thin(t[:50], y[:50], bins=100)[1] is not None


def test_working_points_are_those_of_the_open_edge(model: Model) -> None:
    w, dp = working_points(model, model.edges[0], chunk())
    assert (w > model.edges[0].safe_band_v).all()
    assert ((dp > 1e6) & (dp < 6e6)).all()
    assert 0 < len(w) < 500


def test_matplotlib_waits_until_a_picture_is_wanted() -> None:
    code = (
        "import sys, rtid.replay, rtid.compare, rtid.mapfiles\n"
        "print([m for m in sys.modules if m.startswith('matplotlib')] or '')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == ""
