"""What the noise of the pressures feigns of a flow that the maps follow is told by its products."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

from rtid.diagnose import attenuation
from rtid.diagnose.attenuation import (
    Believed,
    apart_from_noise,
    stands_apart,
    told_apart_from_noise,
)
from rtid.diagnose.consequence import on_finer
from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.nameable import clearest
from rtid.diagnose.regression import LIMIT_SD, Score
from rtid.diagnose.standing import fitted, stand
from rtid.diagnose.trials import scored, with_effect
from rtid.effects.column import Candidate
from rtid.effects.laws import causes
from rtid.effects.laws.lines import AT_CYLINDER
from rtid.estimator.chunk import to_chunk
from rtid.plain import Key
from rtid.sim.demand import IDENTIFICATION
from rtid.sim.run import simulate
from tests.campaign.laws import RECORD_S, Case, declared
from tests.diagnose.records import record

A, B = ("external_leakage_laminar", "a"), ("external_leakage_laminar", "b")


@cache
def fit_of(band: bool, leak: float = 0.0) -> Fit:
    """Of a sweep with a constant supply, whose valves are said to be shut about 0 V, or not."""
    model, chunk, held_out = record(A[0] if leak else "", leak, 4, "sweep_record")
    if not band:
        model = replace(model, edges=tuple(replace(e, safe_band_v=0.0) for e in model.edges))
    return stand(model, chunk, held_out).fit


def told(fit: Fit, key: Key) -> tuple[Score, Believed]:
    """By the rows alone, and apart from the noise of the pressures."""
    candidate, score = clearest(scored(fit))[key]
    assert fit.rows is not None
    (known,) = told_apart_from_noise(fit, fit.rows, [candidate])
    return score, known


def test_of_a_leak_that_only_noise_is_left_of_nothing_is_told() -> None:
    """A healthy machine had one of 5.7 deviations, with a limit that one ten times as large met."""
    fit = fit_of(band=False)
    score, known = told(fit, B)
    assert score.value > LIMIT_SD * score.sd, "the rows alone tell one"
    assert not abs(known.size) > 2.0 * known.sd
    assert known.sd > 5.0 * score.sd
    scores, nothing = apart_from_noise(fit, scored(fit))
    assert {A, B} <= nothing
    assert [s.sd for c, s in scores if c.key == B] == [pytest.approx(known.sd, rel=0.3)]


@pytest.mark.long
def test_where_shut_valves_tell_a_leak_its_size_stays() -> None:
    score, known = told(fit_of(band=True, leak=1e-12), A)
    assert known.size == pytest.approx(score.value, rel=0.05)
    assert known.size == pytest.approx(1e-12, abs=3.0 * max(known.sd, known.sd_by_blocks))
    assert known.sd == pytest.approx(score.sd, rel=0.1)


def test_a_size_is_known_no_better_than_a_finer_grid_agrees(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fit = fit_of(band=True, leak=1e-12)
    candidate, _ = clearest(scored(fit))[A]
    known = Believed(1e-12, 1e-14, 2e-14)
    assert attenuation._on_any_grid(fit, None, candidate, known, 1.0) == known
    finer = replace(fit)
    monkeypatch.setattr(
        attenuation, "_size_beside", lambda on, _: (1e-12 if on is fit else 0.5e-12, 1e-15)
    )
    apart = attenuation._on_any_grid(fit, finer, candidate, known, 1.0).sd_by_blocks
    assert apart == pytest.approx(0.5e-12, rel=0.01), "as far as the other one is"


def test_the_rows_of_a_finer_grid_serve_every_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The size beside a fit there is that of a fit with the candidate in it, made anew there."""
    fit = fit_of(band=True, leak=1e-12)
    candidate, _ = clearest(scored(fit))[A]
    finer = on_finer(fit)
    assert finer is not None
    with monkeypatch.context() as held:
        held.setattr("rtid.diagnose.fit.rows_of", lambda *_, **__: pytest.fail("made anew"))
        value, sd = attenuation._size_beside(finer, candidate)
    record = fit.declared, fit.chunk, fit.weights, with_effect(fit, candidate), fit
    anew = on_finer(one_pass(*record, bank=False, thorough=False))
    assert anew is not None
    assert value == pytest.approx(anew.held.value(anew.column(candidate)), abs=0.01 * sd)
    assert sd == pytest.approx(anew.held.sd(anew.column(candidate)), rel=0.01)


FEIGNED = (902.6, 8.23e-6, 3.8e9)  # rad/s, m3, Pa s/m3: what the noise of a sweep looked like
TRUE = (290.4, 3.0e-4, 3.2e8)


def line(fit: Fit, where: str, shape: tuple[float, ...]) -> Candidate:
    """A line seen at the cylinder, of these numbers."""
    (plain,) = (
        c.candidate
        for c in causes(fit.view)
        if c.candidate.key == ("line_dynamics", where) and AT_CYLINDER in c.candidate.shape_names
    )
    return replace(plain, shape=shape)


@pytest.mark.parametrize(
    ("known", "is_there"),
    [(Believed(0.36, 0.108, 0.19), False), (Believed(0.72, 0.005, 0.016), True)],
)
def test_a_line_is_asked_what_is_there_of_it_apart_from_the_noise(
    monkeypatch: pytest.MonkeyPatch, known: Believed, is_there: bool
) -> None:
    fit = fit_of(band=True, leak=1e-12)
    monkeypatch.setattr(attenuation, "told_apart_from_noise", lambda *_: [known])
    assert stands_apart(fit, line(fit, "b", FEIGNED)) == is_there


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "where", "shape", "is_there"),
    [
        (Case(7001, "orifice", "sweep_record", "internal_leakage_laminar"), "b", FEIGNED, False),
        (Case(7005, "asymmetric", "rich_record", "line_dynamics"), "both", TRUE, True),
    ],
)
def test_a_line_that_only_makes_rows_quieter_is_none(
    case: Case, where: str, shape: tuple[float, ...], is_there: bool
) -> None:
    """It took 1,139 of chi2 on a sweep that matched, and was named with maps bent by 8 %."""
    run = simulate(case.plant, case.motion, case.seed, RECORD_S, case.sensors)
    model = declared(case, run)
    chunk = to_chunk(model, run.samples, 0)
    fit = fitted(model, chunk[chunk[:, 0] < IDENTIFICATION * RECORD_S])
    assert stands_apart(fit, line(fit, where, shape)) == is_there
