"""Figures of a fit to the third-party rig: learned maps and parameters beside its truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.signal import lfilter
from typer.testing import CliRunner

from rtid.compare import ReferenceMap
from rtid.estimator.flowmap import VALID
from rtid.estimator.state import build
from rtid.kernels.explain import explain
from rtid.maps.datasheet import read_reference
from rtid.model import Edge
from rtid.plain import FloatArray
from rtid.project import load
from rtid.study.compared import TraceComparison, compare_trace
from rtid.study.replay import Replay, replay
from tools import table_to_can

ROOT = Path(__file__).parents[1]
PROJECT = ROOT / "rtid" / "project" / "examples" / "cylinder.toml"
TRUE_BETA_PA = 700e6
CONVERTER = typer.Typer()
CONVERTER.command()(table_to_can.main)


@dataclass(frozen=True)
class EdgeFigures:
    """Shares of the edge's largest flow: |block mean - truth| and |flow at nodes - truth|."""

    name: str
    blocks: FloatArray
    nodes: FloatArray
    points: FloatArray


def as_can_log(table: Path, log: Path, *options: str) -> Path:
    """Convert a table to a CAN log with the project's own converter."""
    done = CliRunner().invoke(CONVERTER, [str(table), str(log), *options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return log


def learn(log: Path, project: Path = PROJECT) -> Replay:
    """Replay a log of the rig with the packaged example project."""
    return replay(load(project), log)


def calibrated(shared: Path) -> ReferenceMap:
    """The individually calibrated maps, for scoring only."""
    return read_reference(shared / "data" / "rig" / "truth" / "valve_maps_calibrated.csv")


def figures(replayed: Replay, truth: ReferenceMap) -> list[EdgeFigures]:
    """Learned maps beside the true ones, per edge."""
    compared = compare_trace(replayed, truth)
    return [_edge_figures(i, e, compared, truth) for i, e in enumerate(replayed.model.edges)]


def _edge_figures(
    i: int, edge: Edge, compared: TraceComparison, truth: ReferenceMap
) -> EdgeFigures:
    found = compared.replay
    chunk = found.part(found.identification_s)
    w, dp = _points(edge, found, chunk)
    true = np.where(w > edge.safe_band_v, truth.flow(edge.name, w, dp), 0.0)
    largest = float(np.nanmax(true))
    cells = _cells(compared, chunk)[:, i]
    first = sum(e.grid.shape[0] * e.grid.shape[1] for e in found.model.edges[:i])
    blocks = [
        b.mean_flow_m3s - np.mean(true[cells == first + b.i * edge.grid.shape[1] + b.j])
        for b in found.fit.solution.blocks
        if b.edge == i and b.status == VALID
    ]
    learned = compared.flowmap[edge.name]
    s = learned.status == VALID
    row, column = np.nonzero(s[1:, 1:] & s[:-1, 1:] & s[1:, :-1] & s[:-1, :-1])
    node = edge.grid.u_v[row + 1], edge.grid.dp_pa[column + 1]
    nodes = learned.flow(*node) - truth.flow(edge.name, *node)
    open_ = w > edge.safe_band_v
    points = learned.flow(w[open_], dp[open_]) - true[open_]
    points = points[learned.status_at(w[open_], dp[open_]) == VALID]
    return EdgeFigures(edge.name, *(np.abs(x) / largest for x in (blocks, nodes, points)))


def _points(edge: Edge, replayed: Replay, chunk: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean opening (behind the lag) and mean pressure drop of each interval."""
    model, dt = replayed.model, np.median(np.diff(chunk[:, 0]))
    w = edge.direction * chunk[:, 2 + model.column(edge.command)]
    fade = np.exp(-dt / replayed.fit.lag_s)
    lagged = lfilter([0, 1 - fade], [1, -fade], w - w[0]) + w[0]
    mean = w + (lagged - w) * replayed.fit.lag_s / dt * (1 - fade)
    dp = chunk[:, 2 + model.column(edge.source)] - chunk[:, 2 + model.column(edge.sink)]
    return mean[:-1], 0.5 * (dp[1:] + dp[:-1])


def _cells(compared: TraceComparison, chunk: FloatArray) -> NDArray[np.int64]:
    """Grid cell of every edge over each interval, as the estimator assigned it."""
    found = compared.replay
    n, c, state = len(chunk), len(found.model.chambers), build(found.model, found.fit.weights)
    cells = np.empty((n - 1, len(found.model.edges)), np.int64)
    theta, compliance = compared.flowmap.theta_cells(), found.fit.solution.compliance
    outputs = np.empty((n - 1, 2 * c)), cells, np.empty((n - 1, c))
    explain(state.engine, state.cells, theta, compliance, chunk, *outputs)
    return cells
