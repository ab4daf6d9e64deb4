"""What the maps have taken in: found by its consequence, sized, and quiet where nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose import admission
from rtid.diagnose import consequence as evidence
from rtid.diagnose.admission import is_form_of_another, is_seen_again
from rtid.diagnose.consequence import Consequence, is_stable
from rtid.diagnose.diagnosis import Result, beside_its_line, search
from rtid.diagnose.experiment import FLOW, would_separate
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.residual import Residual, is_known
from rtid.diagnose.revision import Revision
from rtid.diagnose.summary import diagnosis
from rtid.diagnose.trials import Trial, TrialState, material_share
from rtid.diagnose.verdict import MATERIAL
from rtid.effects.record_view import RecordView
from rtid.plain import silent
from rtid.sim.random_plants import draw
from rtid.tell.diagnosed import sentences
from tests.diagnose.records import record

LEAK = "external_leakage_laminar", 1e-12, 4, "sweep"


@pytest.fixture(scope="module")
def result() -> Result:
    return search(*record(*LEAK))


@pytest.fixture(scope="module")
def told(result: Result) -> Diagnosis:
    return diagnosis(result)


def test_a_leak_that_only_the_maps_show_is_named_with_its_size(told: Diagnosis) -> None:
    """The residual falls by less than 0.3 % of the flow: it was "too small to matter"."""
    (own,) = told.found
    names = {own.effect, *(name.split(" ")[0] for name in own.cannot_be_told_from)}
    assert told.verdict in ("missing", "ambiguous") and LEAK[0] in names
    fall = own.heldout_residual_before_m3s**2 - own.heldout_residual_after_m3s**2
    assert fall < (MATERIAL * told.rms_flow_m3s) ** 2
    does = own.hidden_in_map
    assert does is not None
    assert max([*does.maps.values(), *map(abs, does.beta.values())]) >= 0.01
    value = next(iter(own.parameters.values()))
    if own.effect == LEAK[0]:
        assert abs(value.value - LEAK[1]) < max(3 * value.std, 0.1 * LEAK[1])


def test_what_it_bends_is_what_the_map_without_it_is_off_by(result: Result) -> None:
    """Over the places where the map is known: where it is not, it is off by anything."""
    (accepted,) = result.found
    assert accepted.hidden is not None
    first, plant = result.first, draw(LEAK[2])
    view = RecordView.of(first.model, first.sent, first.weights, first.map)
    told_off, truly_off = dict(accepted.hidden.maps), dict[str, float]()
    for i, edge in enumerate(first.model.edges):
        at = is_known(view) & (view.flow(i) != 0.0)
        dp = view.signal(edge.source) - view.signal(edge.sink)
        w = edge.direction * view.signal(edge.command)[:-1][at]
        true = plant.flow(edge.name, w, 0.5 * (dp[1:] + dp[:-1])[at])
        off = view.flow(i)[at] - true
        truly_off[edge.name] = float(np.sqrt(np.mean(off**2)) / np.abs(true).max())
    assert {e for e, off in truly_off.items() if off > 0.005} == {"pa", "at"}
    assert all(told_off[e] == pytest.approx(truly_off[e], rel=0.25) for e in ("pa", "at"))


def test_it_is_said_with_what_it_bends(told: Diagnosis) -> None:
    text = " ".join(sentences(told))
    assert "The maps hide it" in text and "of its largest flow" in text
    assert "vary the supply's pressure" in text
    json = told.as_json()["found"][0]["hidden_in_map"]
    assert set(json) == {"own_flow", "maps", "beta", "separates", "lag_s"}


def test_advice_never_asks_for_what_the_record_has(result: Result) -> None:
    asked = list(would_separate(result.last, FLOW))
    assert any("rest under load" in text for text in asked)
    assert any("supply" in text for text in asked)
    still = result.last.chunk.copy()
    still[:3000, 2 + result.last.declared.column("u")] = 0.0
    supply = 2 + result.last.declared.column("p_supply")
    still[:, supply] *= 1.0 + 0.2 * np.sin(np.arange(len(still)) / 3000)
    has_both = replace(result.last, chunk=still)
    view = replace(result.last.view, chunk=has_both.sent)
    vars(has_both)["view"] = view
    assert not list(would_separate(has_both, FLOW))


Size = tuple[float, float]  # value and standard deviation


@pytest.mark.parametrize(
    ("whole", "apart", "on_finer", "is_believed"),
    [
        ((1.0, 0.02), (0.03, 0.04), (1.0, 0.03), True),
        ((1.0, 0.02), (0.70, 0.04), (1.0, 0.03), False),  # ends half-way
        ((1.0, 0.02), (0.70, 0.90), (1.0, 0.03), False),  # halves tell nothing
        ((1.0, 0.02), (0.03, 0.04), (0.5, 0.03), False),  # the grid made it
    ],
)
def test_a_size_must_be_that_of_both_halves_and_of_a_finer_grid(
    result: Result, monkeypatch: pytest.MonkeyPatch,
    whole: Size, apart: Size, on_finer: Size, is_believed: bool,
) -> None:  # fmt: skip
    told = iter((whole, on_finer))
    monkeypatch.setattr(evidence, "_size", lambda *_: (0, *next(told)))
    monkeypatch.setattr(evidence, "between_halves", lambda *_: apart)
    last, accepted = result.last, result.found[0]
    trial = Trial(accepted.key, accepted.gain, last.revision)
    assert is_stable(last, trial, is_needed=True) == is_believed


@pytest.mark.parametrize(("share", "moves"), [(1e-6, True), (1.0, False)])
def test_a_modulus_moves_where_it_leaves_what_is_told_of_it(
    result: Result, monkeypatch: pytest.MonkeyPatch, share: float, moves: bool
) -> None:
    """What the blocks miss is counted: a clean sweep's modulus, known to 170 %, moved by 6.6 %."""
    first, last = result.first, result.last
    sharp = replace(first, held=replace(first.held, cov=1e-12 * first.held.cov))
    told = np.diag((share * first.compliance) ** 2)
    monkeypatch.setattr(evidence, "counted", lambda _: told)
    assert bool(evidence.consequence(sharp, last, 0.0).beta) == moves


@pytest.mark.parametrize(("shape", "is_believed"), [((), True), ((1.0, 2.0), False)])
def test_each_number_of_what_is_hidden_must_stand_out(
    result: Result, monkeypatch: pytest.MonkeyPatch, shape: tuple[float, ...], is_believed: bool
) -> None:
    """A line of three numbers took 115 of chi2 where a dead volume was hidden, and was named."""
    monkeypatch.setattr(admission, "is_stable", lambda *_: True)
    (accepted,) = result.found
    (leak,) = result.last.revision.effects
    trial = Trial(accepted.key, 250.0, Revision((replace(leak, shape=shape),)))
    residuals = result.before, result.after
    does = admission.taken_in(result.first, result.last, trial, 0.1, *residuals)
    assert (does is not None) == is_believed


@pytest.mark.parametrize(
    ("begins", "before", "after", "is_seen"),
    [
        (1.0, 2.0, 1.1, True),
        (1.0, 2.0, 1.7, False),
        (1.0, 1.1, 1.0, False),
        (-1.0, 2.0, 1.1, False),
    ],
)
def test_what_unseen_data_show_again_is_believed(
    result: Result, begins: float, before: float, after: float, is_seen: bool
) -> None:
    """Most of a clear misfit is gone, in data that have not taught the effect."""
    last, noise = result.last, np.ones((100, 2))
    t_s = last.chunk[-1, 0] + begins + 0.02 * np.arange(100)
    parts = (Residual(t_s, noise, size * noise, noise) for size in (before, after))
    assert is_seen_again(last, *parts) == is_seen


@pytest.mark.parametrize("where", ["a", "b"])
def test_what_a_line_s_own_oil_stores_is_not_told_from_the_line(result: Result, where: str) -> None:
    line, volume = ("line_dynamics", where), ("extra_dead_volume", "a")
    found = [replace(result.found[0], key=key, alike=()) for key in (volume, line)]
    state = TrialState(result.last.declared, result.last.chunk, result.last.chunk, silent, found)
    assert beside_its_line(state, found[0]).alike == ((line,) if where == "a" else ())
    assert beside_its_line(state, found[1]).alike == ()


def test_the_form_of_what_was_found_is_no_effect_of_its_own(result: Result) -> None:
    """A cause that could not be told from another is not named beside it for what that leaves."""
    relief, other = ("relief_valve", "b"), ("relief_valve", "a")
    leak = replace(result.found[0], alike=(relief,))
    state = TrialState(result.last.declared, result.last.chunk, result.last.chunk, silent, [leak])
    assert is_form_of_another(state, relief)
    assert not is_form_of_another(state, other)


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_clean_sweep_stays_quiet(seed: int) -> None:
    said = diagnosis(search(*record("", 0.0, seed, "sweep")))
    assert (said.verdict, said.found) == ("matches", ())


def test_each_limb_alone_is_material() -> None:
    assert Consequence(0.02, (), ()).is_material
    assert Consequence(float("nan"), (("pa", 0.02),), ()).is_material
    assert Consequence(0.0, (), (("a", -0.02),)).is_material
    assert Consequence(float("nan"), (), (), 1e-3).is_material
    assert not Consequence(0.009, (("pa", 0.009),), (("a", 0.009),)).is_material


def test_what_is_left_is_compared_where_both_are_judged() -> None:
    """Beside another lag other rows are: the new ones may be those that are hardly known."""
    t_s, ones = np.arange(50) / 50.0, np.ones((50, 1))
    before = Residual(t_s[:40], ones[:40], 0.5 * ones[:40], 0.1 * ones[:40])
    worse = np.where(t_s[:, None] < 0.7, 0.2, 5.0)
    after = Residual(t_s[5:], ones[5:], worse[5:], 0.1 * ones[5:])
    assert len(before.at_rows_of(after).t_s) == len(after.at_rows_of(before).t_s) == 35
    assert admission.leaves_more(before, after)
    better = Residual(t_s[5:], ones[5:], np.where(t_s[5:, None] < 0.8, 0.3, 5.0), 0.1 * ones[5:])
    assert better.rms_m3s > 2.0 * before.rms_m3s
    assert not admission.leaves_more(before, better)
    assert material_share(before, better) == pytest.approx(np.sqrt(0.5**2 - 0.3**2))
