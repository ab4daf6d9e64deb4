"""Pictures: they show what is there, lose no spike, and come out the same each time."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure

from rtid.compare import (
    FREE_RUN,
    BlockRow,
    Comparison,
    Correlation,
    Cusum,
    Dependence,
    Examination,
    Intervals,
    Simulation,
)
from rtid.compare.tables import CAUSES, NEVER
from rtid.estimator.flowmap import VALID, FlowMap
from rtid.estimator.published import publish
from rtid.kernels.free_run import GAP, INSIDE
from rtid.model import Machine
from rtid.tell.charts.correlation import correlogram, cusum
from rtid.tell.charts.coverage import coverage
from rtid.tell.charts.dependence import dependences
from rtid.tell.charts.maps import maps, slices
from rtid.tell.charts.over_time import beside, pressures, residual
from rtid.tell.charts.points import working_points
from rtid.tell.charts.where import HATCHES, residual_map
from rtid.tell.stills import draw, save, thin
from tests.flow_maps import machine, orifice, solved


@pytest.fixture(scope="module")
def model() -> Machine:
    return machine(edges=2)


@pytest.fixture(scope="module")
def flowmap(model: Machine) -> FlowMap:
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


def drawings(model: Machine, flowmap: FlowMap) -> dict[str, Figure]:
    return {
        "coverage": coverage(model, flowmap, chunk()),
        "maps": draw(maps(flowmap)),
        "slices": draw(slices(flowmap, flowmap, reference_name="sheet")),
        "residual": draw(residual(model, {"identification": part(), "validation": part(300)})),
        **examined(model),
    }


def examination(rows: int = 2000) -> Examination:
    """What an examination of one chamber looks like, with a change at 25 s."""
    rng, t_s = np.random.default_rng(1), np.linspace(0.0, 40.0, rows)
    p = 3e6 + 1e6 * np.sin(t_s)[:, None]
    error = 1e4 * rng.standard_normal((rows, 1))
    status = np.where(np.arange(rows) % 500 == 0, GAP, INSIDE)
    run = Simulation(
        FREE_RUN, np.inf, t_s, p, np.where(status[:, None] == GAP, np.nan, p + error), status
    )
    bins = np.linspace(-5, 5, 11)
    mean = 1e-6 * bins[:-1, None]
    rows_of, one = np.full(10, 50), np.ones(1)
    binned = Dependence(
        "u", "V", bins[:-1], bins[1:], bins[:-1], mean, 0 * mean + 2e-7, mean**2, rows_of, one
    )
    lags = np.linspace(-0.2, 0.2, 401)
    cross = Correlation("a", "u", lags, 0.1 * np.sinc(20 * (lags - 0.05)), np.full(401, 0.02))
    own = Correlation("a", "", lags[201:], 0.02 * rng.standard_normal(200), np.full(200, 0.02))
    total = np.where(t_s > 25, 8 * (t_s - 25), 0.0)
    found = Cusum("a", 0.05, t_s, total, 40 + t_s, 34.0, 25.0)
    three = replace(
        binned,
        signal="direction",
        **{k: v[:3] for k, v in vars(binned).items() if k not in ("signal", "unit", "explained")},
    )
    time = replace(binned, signal="time", unit="s")
    return Examination(
        part(rows), {FREE_RUN: run}, "", [binned], three, time, [own, cross], [found]
    )


def examined(model: Machine) -> dict[str, Figure]:
    one, two = examination(), examination(800)
    charts = {
        "pressures": pressures(
            model, {"identification": one.simulations, "validation": two.simulations}
        ),
        "dependences": dependences(model, one.signals, one.direction, one.time),
        "correlogram": correlogram(one.correlations),
        "cusum": cusum({"identification": one.cusums, "validation": two.cusums}),
        "beside": beside(model, {"one": {"identification": one}, "two": {"identification": two}}),
    }
    figures = {name: draw(chart) for name, chart in charts.items()}
    return figures | {"residual_map": residual_map(model, rows_of_blocks())}


def rows_of_blocks() -> list[BlockRow]:
    reasons = ("", "3 rows, 20 needed", "condition number 1e9", "flow known to 2 %", NEVER)
    return [
        BlockRow(
            "e0",
            i,
            j,
            (1.0 + 0.25 * i, 1.25 + 0.25 * i),
            (5e5 * j, 5e5 * j + 5e5),
            rows=100,
            dwell_s=1.0,
            condition=1e3,
            flow_m3s=1e-4,
            sd_m3s=1e-6,
            residual_rms_m3s=1e-6 * i if i % 3 else np.nan,
            residual_share=0.01 * i,
            status="learning" if reasons[j] else "valid",
            reason=reasons[j],
        )
        for i in range(10)
        for j in range(5)
    ]


def test_a_stopped_run_leaves_a_hole_in_its_line(model: Machine) -> None:
    figure = draw(pressures(model, {"identification": examination().simulations}))
    (error,) = [line for line in figure.axes[1].lines if line.get_label() == "measured less model"]
    y = np.asarray(error.get_ydata(), float)
    runs = np.split(y, np.flatnonzero(np.isnan(y)))
    assert sum(len(run) > 400 for run in runs) == 4


def test_every_reason_has_a_hatch_of_its_own(model: Machine) -> None:
    axis = residual_map(model, rows_of_blocks()).axes[0]
    hatches = {c.get_hatch() for c in axis.collections if isinstance(c, PatchCollection)}
    assert hatches >= {HATCHES[cause] for cause in CAUSES if cause not in (CAUSES[0], CAUSES[4])}


def test_the_beginning_of_the_failure_is_marked(model: Machine) -> None:
    axis = draw(cusum({"identification": examination().cusums})).axes[0]
    said = {text.get_position()[0]: text.get_text().strip() for text in axis.texts}
    assert said == {25.0: "begins to fail at 25.0 s", 34.0: "leaves"}
    assert [25.0, 25.0] in [list(line.get_xdata()) for line in axis.lines]  # type: ignore[arg-type]


@pytest.mark.first_of(1)
@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_every_picture_is_written(
    model: Machine, flowmap: FlowMap, tmp_path: Path, suffix: str
) -> None:
    heads = {".png": b"\x89PNG", ".svg": b"<?xml"}
    for name, figure in drawings(model, flowmap).items():
        path = save(figure, tmp_path / f"{name}{suffix}")
        assert path.read_bytes()[:5].startswith(heads[suffix])
        assert path.stat().st_size > 10_000


def test_same_map_same_bytes(flowmap: FlowMap, tmp_path: Path) -> None:
    one, two = (save(draw(maps(flowmap)), tmp_path / f"{k}.svg").read_bytes() for k in (1, 2))
    assert one == two


def test_everything_that_is_not_valid_is_hatched(flowmap: FlowMap) -> None:
    for axis, edge in zip(draw(maps(flowmap)).axes, flowmap.edges, strict=False):
        veils = [c for c in axis.collections if isinstance(c, PatchCollection)]
        assert [v.get_hatch() for v in veils] == ["////"]
        assert len(veils[0].get_paths()) == (edge.status != VALID).sum()


def test_slices_show_the_reference_as_dots(flowmap: FlowMap) -> None:
    axis = draw(slices(flowmap, flowmap, u_v=[3.0, 5.0])).axes[0]
    (dots,) = [line for line in axis.lines if line.get_marker() == "o"]
    dp = np.asarray(dots.get_xdata(), float).reshape(2, -1) * 1e6
    q_lpm = np.asarray(dots.get_ydata(), float).reshape(2, -1)
    for k, w_v in enumerate((3.0, 5.0)):
        np.testing.assert_allclose(q_lpm[k], flowmap.flow("e0", w_v, dp[k]) * 6e4)


def test_a_spike_of_one_row_is_drawn(model: Machine) -> None:
    figure = draw(residual(model, {"all": part(40_000, spike=1e-4)}))
    lowest = max(np.nanmax(np.asarray(line.get_ydata(), float)) for line in figure.axes[1].lines)
    assert lowest == pytest.approx(6.0)


def test_a_part_without_rows_is_an_empty_panel(model: Machine, tmp_path: Path) -> None:
    chart = residual(model, {"identification": part(), "validation": part(0)})
    save(draw(chart), tmp_path / "r.png")


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


def test_working_points_are_those_of_the_open_edge(model: Machine) -> None:
    w, dp = working_points(model, model.edges[0], chunk())
    assert (w > model.edges[0].safe_band_v).all()
    assert ((dp > 1e6) & (dp < 6e6)).all()
    assert 0 < len(w) < 500


def test_matplotlib_waits_until_a_picture_is_wanted() -> None:
    code = (
        "import sys, rtid.study.replay, rtid.compare, rtid.maps.files\n"
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
