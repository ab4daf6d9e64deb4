"""Rows of every column at once are the rows of the estimator; means of rows lose nothing."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtid.diagnose import evidence
from rtid.diagnose.evidence import Heading, Rows, project, rows_of
from rtid.effects.law import Volumes
from rtid.estimator import state
from rtid.estimator.factor import PRIOR_SD
from rtid.estimator.record import run
from rtid.estimator.state import build, nominal_weights
from rtid.estimator.sums import Sums
from rtid.kernels import products
from rtid.kernels.following import follow_map
from rtid.kernels.layout import TERMS
from tests.diagnose.records import record

ROOT = Path(__file__).parents[2]


def head(rows: Rows, given: list[Volumes]) -> tuple[np.ndarray, np.ndarray]:
    """Products of y, theta_beta and condensed columns among themselves, and of the maps."""
    heading = Heading(rows)
    for column in given:
        heading.put(column)
    return heading.products()


def gram_of(rows: Rows, given: list[Volumes] | None = None) -> np.ndarray:
    """Products of all columns: head, then maps."""
    own, cross = head(rows, given or [])
    cross = along_terms(rows) @ cross
    return np.block([[own, cross.T], [cross, whole_maps(rows)]])


def along_terms(rows: Rows) -> np.ndarray:
    """The told directions in the blocks' terms (6 V, n)."""
    span, _ = rows.told
    return np.asarray(span.terms(np.eye(span.n)).reshape(span.n, -1).T)


def whole_maps(rows: Rows) -> np.ndarray:
    """Products of the maps' terms (6 V, 6 V)."""
    maps, along = rows.maps(), along_terms(rows)
    return np.asarray(along @ (np.tril(maps) + np.tril(maps, -1).T) @ along.T)


@pytest.mark.parametrize(("quiet", "within"), [(1e-9, 1e-8), (evidence.QUIET, 1e-4)])
def test_rows_are_those_of_the_estimator(
    quiet: float, within: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One position per row: the same products as the recursive sums, in units of their sizes.

    A block is dropped when its whitened state is below QUIET, which is all that is lost.  A sweep:
    the estimator begins a new memory where more blocks ring than it has places for.
    """
    monkeypatch.setattr(evidence, "QUIET", quiet)
    monkeypatch.setattr(state, "SETTLES", 0.0)  # the sums take the first rows as they are
    model, chunk, _ = record(motion="sweep")
    chunk = chunk[:4000]
    weights = nominal_weights(model)
    found = rows_of(model, chunk, weights, row_s=1e-3)
    sums = Sums.of(run(model, chunk, weights))
    normal = sums.normal()
    assert run(model, chunk, weights).counters["restart_memory"] == 0
    place = {cell: k for k, cell in enumerate(found.cells)}
    blocks = [3 + TERMS * place[cell] for cell in sums.cells]
    at = [1, 2, *(first + j for first in blocks for j in range(TERMS))]
    gram = gram_of(found)
    size = np.sqrt(np.outer(np.diag(normal.gram), np.diag(normal.gram)))
    assert np.abs((gram[np.ix_(at, at)] - normal.gram) / size).max() < within
    assert gram[0, 0] == pytest.approx(normal.square, rel=1e-9)
    assert found.n == 2 * normal.rows


def dense(rows: Rows) -> np.ndarray:
    """Whitened rows of the maps' columns, (scalar rows, 6 V)."""
    n, n_c, _ = rows.own.shape
    columns = np.zeros((n, n_c, TERMS * len(rows.cells)))
    for r in range(n):
        for k in range(rows.start[r], rows.start[r + 1]):
            at = TERMS * rows.block[k]
            for c in range(n_c):
                columns[r, c, at : at + TERMS] += rows.sign[rows.block[k], c] * rows.terms[k]
    products.whitened(columns, rows.fresh, rows.whiten, rows.keep)
    return columns.reshape(n * n_c, -1)


@pytest.mark.parametrize("row_s", [1e-3, 1e-2])
def test_products_are_those_of_whole_rows(row_s: float) -> None:
    """What rings is met once in a span, and the head by its adjoint: the same, to rounding."""
    model, chunk, _ = record()
    chunk = chunk[:6000].copy()
    chunk[2500, 1] = 3  # and behind a gap
    rows = rows_of(model, chunk, nominal_weights(model), row_s=row_s)
    whole, maps = dense(rows), whole_maps(rows)
    expected = whole.T @ whole
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected))) + 1e-300
    assert np.abs((maps - expected) / size).max() < 1e-9
    flat = rows.whitened(rows.own.copy()).reshape(rows.n, -1)
    _, cross = head(rows, [])
    scale = np.sqrt(np.outer(np.diag(expected), (flat**2).sum(axis=0))) + 1e-300
    assert np.abs((along_terms(rows) @ cross - whole.T @ flat) / scale).max() < 1e-9


def test_covariances_are_blocks_of_the_inverse() -> None:
    model, chunk, _ = record()
    rows = rows_of(model, chunk[:3000], nominal_weights(model))
    full = whole_maps(rows) + np.eye(TERMS * len(rows.cells)) * PRIOR_SD**-2
    assert rows.told[0].n < len(full)
    inverse = np.linalg.inv(full)
    for v, cov in enumerate(rows.covariances):
        at = slice(TERMS * v, TERMS * (v + 1))
        size = np.sqrt(np.outer(np.diag(inverse[at, at]), np.diag(inverse[at, at])))
        assert np.abs((cov - inverse[at, at]) / size).max() < 1e-5


@pytest.mark.parametrize("motion", ["rich", "sweep"])
def test_what_is_due_is_the_trace_of_all_that_rows_tell(motion: str) -> None:
    """In place of a count of what they touch: few rows of a block take less than it has terms."""
    model, chunk, _ = record(motion=motion)
    rows = rows_of(model, chunk[:3000], nominal_weights(model))
    maps = whole_maps(rows)
    known = np.linalg.eigvalsh(maps)
    taken = float(np.sum(known / (known + PRIOR_SD**-2)))
    assert rows.n - rows.due == pytest.approx(taken, abs=0.01)
    assert taken < rows.told[0].n - 1.0


@pytest.mark.parametrize("motion", ["rich", "sweep"])
def test_what_is_left_out_tells_next_to_nothing_beside_the_prior(motion: str) -> None:
    """With all that rings on: products of the directions without a say, of whole maps."""
    model, chunk, _ = record(motion=motion)
    rows = rows_of(model, chunk[:8000], nominal_weights(model))
    directions, _ = rows.told
    whole = dense(rows)
    maps = whole.T @ whole
    count, most = np.diff(directions.first), []
    for v in np.flatnonzero(count < TERMS):
        at = slice(TERMS * v, TERMS * (v + 1))
        rest = directions.basis[v][:, count[v] :]
        most.append(np.linalg.eigvalsh(rest.T @ maps[at, at] @ rest)[-1] * PRIOR_SD**2)
    assert most and max(most) < 1e-5


def test_a_factor_that_was_let_go_is_made_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A large one; of a small one nobody's memory is short."""
    model, chunk, _ = record()
    rows = rows_of(model, chunk[:2000], nominal_weights(model))
    upper, cov = rows.factor.upper.copy(), rows.covariances
    rows.forget()
    assert "factor" in vars(rows)
    monkeypatch.setattr(evidence, "MANY", 10)
    rows.forget()
    assert "factor" not in vars(rows) and rows.covariances is cov
    assert np.array_equal(rows.factor.upper, upper)


def test_a_given_column_is_its_own_sum() -> None:
    """-V dP given from outside has the products of the built-in column."""
    model, chunk, _ = record()
    chunk = chunk[:5000]
    weights = nominal_weights(model)
    series = []
    for c, chamber in enumerate(model.chambers):
        p = chunk[:, 2 + model.column(chamber.pressure)]
        v = chamber.v0_m3 + chamber.sign * chamber.area_m2 * chunk[:, 2 + model.column("x")]
        series.append(-weights.compliance[c] * 0.5 * (v[1:] + v[:-1]) * np.diff(p))
    rows = rows_of(model, chunk, weights)
    gram, _ = head(rows, [{c: rows.condensed(s)} for c, s in enumerate(series)])
    assert gram[3:5, 3:5] == pytest.approx(gram[1:3, 1:3], rel=1e-9)
    assert gram[0, 3:5] == pytest.approx(gram[0, 1:3], rel=1e-9)


def test_columns_that_stand_aside_meet_the_others_alone() -> None:
    model, chunk, _ = record()
    rows = rows_of(model, chunk[:3000], nominal_weights(model))
    rng, aside = np.random.default_rng(1), Heading(rows)
    columns = [{c: rng.standard_normal(len(rows.own))} for c in (0, 1) for _ in range(20)]
    for k, column in enumerate(columns):
        aside.put(column, is_aside=k > 0)
    all_of_them, seen = project(rows, columns), aside.projected()
    told = np.isfinite(seen.schur)
    assert told[:4].all() and told[:, :4].all() and (told.sum(axis=0)[4:] == 5).all()
    assert seen.schur[told] == pytest.approx(all_of_them.schur[told], rel=1e-9)
    assert seen.own == pytest.approx(all_of_them.own, rel=1e-12)


def test_means_of_positions_keep_the_information() -> None:
    """Rows of 10 ms know the bulk modulus: its variance is at most 1.3 times that of 1 ms."""
    model, chunk, _ = record()
    weights = nominal_weights(model)
    left = [project(rows_of(model, chunk, weights, row_s=s), []).schur[1, 1] for s in (1e-3, 1e-2)]
    assert left[0] / left[1] < 1.3


def test_a_gap_starts_anew() -> None:
    """Half a record, a gap, the other half: the products of both halves add up."""
    model, chunk, _ = record()
    chunk = chunk[:6000].copy()
    weights = nominal_weights(model)
    chunk[3000, 1] = 3
    whole = rows_of(model, chunk, weights, row_s=1e-3)
    halves = [rows_of(model, part, weights, row_s=1e-3) for part in (chunk[:3000], chunk[3000:])]
    squares = [gram_of(rows)[0, 0] for rows in (whole, *halves)]
    assert squares[0] == pytest.approx(sum(squares[1:]), rel=1e-9)
    assert whole.n == sum(h.n for h in halves)


CODE = """
import pickle, sys
import numpy as np
from numba import config
from rtid.kernels import housekeeping, record_rows
from tests.diagnose import test_evidence as own

def with_attributes(kernel):
    return lambda engine, cells, *rest: kernel(
        *(a.view((np.record, a.dtype)) for a in (engine, cells)), *rest)

if config.DISABLE_JIT:  # interpreted, e.running needs a record type
    for module, name in ((housekeeping, "clear"), (record_rows, "integrate")):
        setattr(module, name, with_attributes(getattr(module, name)))
with open(sys.argv[1], "rb") as file:
    model, chunk = pickle.load(file)
gram = own.gram_of(own.rows_of(model, chunk, own.nominal_weights(model)))
print(" ".join(float(v).hex() for v in gram[:9].ravel()))
"""


def test_interpreted_kernels_give_the_same(tmp_path: Path) -> None:
    """With numba switched off: the same Python source, the same sums to 1e-9."""
    model, chunk, _ = record()
    (tmp_path / "record").write_bytes(pickle.dumps((model, chunk[:400])))
    found = []
    for disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-c", CODE, str(tmp_path / "record")]
        done = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT
        )
        found.append(np.array([float.fromhex(v) for v in done.stdout.split()]))
    assert found[0] == pytest.approx(found[1], rel=1e-9, abs=1e-6)


def test_the_map_is_followed_with_its_slopes() -> None:
    """Q, dQ/dw and dQ/ddp along a record are those of the terms, by finite differences of Q."""
    model, chunk, _ = record()
    chunk = chunk[:2000]
    rng = np.random.default_rng(1)
    theta = rng.standard_normal((model.n_cells, TERMS)) * 1e-4

    def flows(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        state = build(model)
        along = np.empty((len(samples), len(model.edges), 5))
        cell = np.empty(along.shape[:2], np.int64)
        cov = np.zeros((model.n_cells, TERMS, TERMS))
        was = np.full((len(model.edges), 2), np.nan)
        follow_map(state.engine, state.cells, theta, cov, samples, 0, along, cell, was)
        return along[1:], cell[1:]

    along, cell = flows(chunk)
    shifted = chunk.copy()
    shifted[:, 2 + model.column("p_supply")] += 100.0
    moved, cell_moved = flows(shifted)
    edge = [e.name for e in model.edges].index("pa")
    same = (cell[:, edge] >= 0) & (cell[:, edge] == cell_moved[:, edge])
    rise = (moved[same, edge, 1] - along[same, edge, 1]) / 100.0
    slope = 0.5 * (moved[same, edge, 3] + along[same, edge, 3])
    assert same.sum() > 100
    assert rise == pytest.approx(slope, rel=1e-6, abs=1e-16)


def test_slopes_along_a_ramp_add_up_to_what_the_map_rises() -> None:
    """The steps from block to block are in them: a lag looked the other way without, on ramps."""
    model, chunk, _ = record()
    chunk = chunk[:60].copy()
    chunk[:, 2:] = chunk[0, 2:]
    ramp = np.linspace(0.0, 8.0, len(chunk))  # a block or less per sample, as narrow as they are
    chunk[:, 2 + model.column(model.edges[0].command)] = ramp
    theta = np.random.default_rng(2).standard_normal((model.n_cells, TERMS)) * 1e-4
    theta[:, 3] = 0.0  # straight along the command: a slope is that of the way to a sample
    engine, along = build(model), np.empty((len(chunk), len(model.edges), 5))
    cell, was = np.empty(along.shape[:2], np.int64), np.full((len(model.edges), 2), np.nan)
    none = np.zeros((0, TERMS, TERMS))
    follow_map(engine.engine, engine.cells, theta, none, chunk, 0, along, cell, was)
    edge = next(i for i, e in enumerate(model.edges) if e.direction > 0)
    is_open = cell[:, edge] >= 0
    assert len(np.unique(cell[is_open, edge])) > 5
    w, q, slope = along[is_open, edge, :3].T
    jumps = np.abs(np.diff(q)).sum()
    assert (slope[1:] @ np.diff(w)) == pytest.approx(q[-1] - q[0], abs=1e-9 * jumps)
