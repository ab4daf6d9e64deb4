"""The parts of a design, each against what it must be."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from rtid.excite import design as designing
from rtid.excite.design import CandidateSegment, design, missing, stitched
from rtid.excite.driving import SHUT, STEP_S, SUPPLY, V_REF, X_REF
from rtid.excite.information import Information
from rtid.excite.library import Segment, library
from rtid.excite.machine import DrivenMachine
from rtid.excite.motion_limits import Extremes, LimitError, Limits, extremes, require_kept
from rtid.excite.selection import (
    BOUNDED,
    MOMENTS,
    KnownCells,
    SelectionProblem,
    choose,
    standard_errors,
    value,
)
from rtid.plain import FloatArray

LIMITS = Limits(
    20.0, (0.08, 0.42), 0.3, 9.0, (1e5, 1e7), (5e6, 8.5e6), supply_rate_paps=5e6, offset_v=0.6
)


def test_moments_are_those_of_a_block() -> None:
    z = np.linspace(-1, 1, 401)
    xi, eta = (a.ravel() for a in np.meshgrid(z, z))
    phi = np.stack([np.ones_like(xi), xi, eta, xi**2, eta**2, xi * eta])
    assert np.allclose(phi @ phi.T / len(xi), MOMENTS, atol=5e-3)


def test_a_block_that_nothing_tells_of_is_unknown_and_rows_make_it_known() -> None:
    phi = np.random.default_rng(0).uniform(-1, 1, (500, 6))
    nothing, some = standard_errors(np.stack([np.zeros((6, 6)), 1e4 * phi.T @ phi]))
    assert nothing > 10.0
    assert some < 0.01
    assert standard_errors(4e4 * (phi.T @ phi)[None])[0] == pytest.approx(some / 2, rel=1e-3)


def test_segments_begin_and_end_at_rest_at_home_within_the_limits() -> None:
    for segment in library(LIMITS)[::3]:
        r = segment.reference
        assert np.allclose(r[[0, -1], X_REF], 0.25, atol=1e-3)
        assert (r[[0, -1], V_REF] == 0.0).all()
        assert r[:, X_REF].min() > 0.08
        assert r[:, X_REF].max() < 0.42
        assert np.abs(np.diff(r[:, X_REF]) / STEP_S - r[:-1, V_REF]).max() < 1e-9
        assert r[:, SUPPLY].min() >= 5e6
        assert r[:, SUPPLY].max() <= 8.5e6
        assert np.abs(np.diff(r[:, SUPPLY])).max() <= 5e6 * STEP_S * (1 + 1e-9)
        assert np.abs(r[:, V_REF]).max() <= 0.3 * (1 + 1e-9)


def test_a_segment_that_is_scaled_is_the_same_nearer_to_home() -> None:
    segment = library(LIMITS)[0]
    small = segment.scaled(0.5, 0.25).reference
    assert np.allclose(small[:, X_REF] - 0.25, 0.5 * (segment.reference[:, X_REF] - 0.25))
    assert np.allclose(small[:, V_REF], 0.5 * segment.reference[:, V_REF])
    assert np.array_equal(small[:, SUPPLY:], segment.reference[:, SUPPLY:])


def test_a_segment_that_breaks_a_limit_beside_the_others_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One goes 5 mm beyond the stroke; one stays within it, but not within half of the margin."""

    def position(
        _machine: DrivenMachine, limits: Limits, r: FloatArray, _run: FloatArray
    ) -> list[Extremes]:
        x = r[:, X_REF]
        return [Extremes("position", "m", x.min(), x.max(), *limits.stroke_m, 0.0)]

    monkeypatch.setattr(designing, "checked", position)
    monkeypatch.setattr(designing, "working_weights", lambda *_: np.ones(3))
    rest = np.tile([0.25, 0.0, 0.0, 6e6, 0.0], (3000, 1))
    names = {"within": 0.1, "close": 0.169, "beyond": 0.175}
    pool = []
    for cell, (name, way) in enumerate(names.items()):
        reference = rest.copy()
        reference[1000:2000, X_REF] += way
        pool.append(CandidateSegment(Segment(name, reference), _told(cell, 1e6)))
    machine = SimpleNamespace(model=SimpleNamespace(n_cells=3), run=lambda reference: reference)
    found = design(cast("DrivenMachine", machine), LIMITS, None, pool)
    assert {c.segment.name for c in found.segments} == {"within"}
    with pytest.raises(LimitError, match="no segment"):
        design(cast("DrivenMachine", machine), LIMITS, None, pool[2:])


def test_what_is_known_well_enough_gains_nothing() -> None:
    rows = np.array([100.0])
    well, better = (BOUNDED.value(s * np.eye(6)[None], rows) for s in (1e10, 1e12))
    poor, fair = (BOUNDED.value(s * np.eye(6)[None], rows) for s in (1e2, 1e4))
    assert better - well < 0.01 < 1.0 < fair - poor


def test_what_is_not_allowed_is_not_in_the_library() -> None:
    plain = replace(LIMITS, supply_pa=(7e6, 7e6), offset_v=0.0, may_shut=False)
    every = np.concatenate([s.reference for s in library(plain)])
    assert (every[:, SUPPLY] == 7e6).all()
    assert not every[:, SHUT].any()
    assert not every[:, 2].any()


def test_a_row_of_segments_keeps_the_supplys_rate_and_the_time() -> None:
    pool = [CandidateSegment(s, _told(0, 1.0)) for s in library(LIMITS)[::9]]
    kept, reference, playing = stitched(pool, LIMITS)
    assert len(playing) == len(reference)
    assert (np.diff(playing) >= 0).all()
    assert set(playing.tolist()) == set(range(len(kept)))
    assert 0 < len(kept) < len(pool)
    assert len(reference) * STEP_S <= LIMITS.duration_s
    assert np.abs(np.diff(reference[:, SUPPLY])).max() <= 5e6 * STEP_S * (1 + 1e-9)


def _told(cell: int, size: float) -> Information:
    return Information(np.array([cell]), size * np.eye(6)[None], np.array([100.0]))


def test_the_choice_prefers_what_is_new_and_keeps_the_time() -> None:
    told = [_told(0, 1e6), _told(0, 9e5), _told(1, 1e5)]
    problem = SelectionProblem(told, np.array([4.0, 4.0, 4.0]), np.ones(2))
    chosen = choose(problem, KnownCells.nothing(2), 9.0)
    assert sorted(chosen) == [0, 2]


def test_an_exchange_repairs_a_greedy_choice() -> None:
    """The first in sight takes the time of two that tell more together."""
    both = Information(np.array([0, 1]), np.full((2, 1, 1), 1e3) * np.eye(6), np.full(2, 60.0))
    told = [both, _told(0, 1e7), _told(1, 1e7)]
    problem = SelectionProblem(told, np.array([5.0, 5.0, 5.0]), np.ones(2))
    chosen = choose(problem, KnownCells.nothing(2), 10.0)
    assert value(problem, KnownCells.nothing(2), chosen) == pytest.approx(
        value(problem, KnownCells.nothing(2), [1, 2])
    )


def test_what_is_learned_is_not_missing() -> None:
    segment = Segment("", np.zeros((10, 5)))
    pool = [CandidateSegment(segment, _told(0, 1e6)), CandidateSegment(segment, _told(1, 1e6))]
    known = KnownCells.nothing(2)
    assert missing(pool, known, np.ones(2)).cells.tolist() == [0, 1]
    known.add(_told(0, 1e9))
    left = missing(pool, known, np.ones(2))
    assert (left.cells.tolist(), left.effects, left.segments) == ([1], (), (pool[1],))
    known.add(_told(1, 1e9))
    assert missing(pool, known, np.ones(2)).segments == ()


def test_an_effect_is_missing_until_it_can_be_seen_well() -> None:
    leak = "external_leakage_laminar", "a"
    told = replace(_told(0, 1e6), effects={leak: 1.0})
    pool, known = [CandidateSegment(Segment("", np.zeros((10, 5))), told)], KnownCells.nothing(1)
    known.add(_told(0, 1e9))
    assert missing(pool, known, np.ones(1)).effects == (leak,)
    known.effects[leak] = 100.0
    assert missing(pool, known, np.ones(1)).effects == ()


def test_the_pieces_that_tell_most_do_not_tell_the_same() -> None:
    both = Information(np.array([0, 1]), 1e6 * np.stack([np.eye(6)] * 2), np.full(2, 60.0))
    told = [_told(0, 1e6), both, _told(1, 1e6), _told(2, 1e6)]
    pool = [CandidateSegment(Segment(str(k), np.zeros((10, 5))), t) for k, t in enumerate(told)]
    pieces = missing(pool, KnownCells.nothing(3), np.ones(3)).pieces(3)
    assert [(c.segment.name, n) for c, n in pieces] == [("1", 2), ("3", 1)]


def test_every_broken_limit_is_named_with_its_place() -> None:
    reference = np.zeros((100, 5))
    reference[:, SUPPLY] = 9e6
    t = STEP_S * np.arange(100, dtype=np.float64)
    found = extremes(LIMITS, reference, t, 0.25 + 4.0 * t, np.full(100, 9.5), np.full((100, 2), 0))
    with pytest.raises(LimitError) as error:
        require_kept(found)
    for word in ("position", "speed", "command", "pressure", "supply"):
        assert word in str(error.value)
    assert "0.10 s" in str(error.value)


def test_limits_that_leave_no_motion_are_refused() -> None:
    with pytest.raises(LimitError, match="stroke, speed"):
        replace(LIMITS, stroke_m=(0.4, 0.1), speed_mps=0.0)


def test_value_counts_no_segment_twice() -> None:
    problem = SelectionProblem([_told(0, 1e6)], np.array([1.0]), np.ones(1), BOUNDED)
    once, twice = (value(problem, KnownCells.nothing(1), [0] * n) for n in (1, 2))
    assert once < twice < 2 * once
