"""Which causes a record does not tell apart: ties, refuted ones, and what is taken of equals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from rtid.diagnose import contest as module
from rtid.diagnose.contest import (
    REFUTED,
    alike_ones,
    contest,
    its_turn,
    outdone_by,
    passed_over,
)
from rtid.diagnose.revision import Revision
from rtid.diagnose.trials import TIE, TIE_SHARE, Trial
from rtid.effects.column import Candidate
from rtid.effects.laws.openings import leaks_at, poppets_at
from rtid.plain import Key

DOF = 4000.0


def trial(effect: str, gain: float, *shape: float) -> Trial:
    own = Candidate(effect, "a", "size", "1", 1.0, shape=shape, shape_names=("w",) * len(shape))
    return Trial((effect, "a"), gain, Revision(effects=(own,)))


def present(misfit: float) -> Any:
    """A fit that leaves so much beyond its degrees of freedom."""
    return SimpleNamespace(
        regression=SimpleNamespace(dof=DOF), held=SimpleNamespace(sse=DOF + misfit), excess=misfit
    )


def state(*negligible: str, has_pressures: bool = True) -> Any:
    model = SimpleNamespace(has_pressures=has_pressures)
    return SimpleNamespace(negligible={(name, "a"): 0.0 for name in negligible}, model=model)


def alike(misfit: float, *gains: float, known: Any = None) -> set[str]:
    trials = [trial(f"cause {k}", gain) for k, gain in enumerate(gains)]
    return {name for name, _ in alike_ones(known or state(), present(misfit), trials[0], trials)}


def test_all_but_as_good_is_alike() -> None:
    """Where much is left besides, a few per cent of the gain are not told apart, and no more."""
    bar = 1000 - TIE - TIE_SHARE * 1000
    assert alike(5000, 1000, bar + 1, bar - 1) == {"cause 1"}


def test_one_that_leaves_several_times_the_misfit_is_refuted() -> None:
    """The best leaves nothing: 1 % of 100,000 is more than noise, though the gains are near."""
    left = REFUTED * 0.05 * DOF
    assert alike(100_000, 100_000, 100_000 - left + 1, 100_000 - left - TIE - 1) == {"cause 1"}


def test_without_pressures_all_that_is_left_counts() -> None:
    """The disturbance was as large as all: one that leaves several times the best's is out."""
    gains = 0.99 * DOF, (1 - 0.01 * REFUTED) * DOF, (1 - 0.01 * (REFUTED + 1)) * DOF
    assert alike(0, *gains, known=state(has_pressures=False)) == {"cause 1"}
    assert alike(0, *gains) == {"cause 1", "cause 2"}


def test_what_changes_next_to_nothing_is_no_rival() -> None:
    assert alike(5000, 1000, 999, 998, known=state("cause 2")) == {"cause 1"}


@pytest.fixture
def refits(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Gains that refits to the end give, by cause; others keep theirs."""
    gains: dict[str, float] = {}

    def finished(state_: Any, present_: Any, t: Trial) -> Trial:
        return Trial(t.key, gains.get(t.key[0], t.gain), t.revision)

    monkeypatch.setattr(module, "_finished", finished)
    return gains


def test_alone_it_is_taken_without_a_refit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_finished", lambda *_: pytest.fail("refitted"))
    best, other = trial("leak", 1000), trial("air", 100)
    assert contest(state(), present(2000), best, [best, other], {}) == (best, ())


def test_a_refit_decides_between_two_that_look_alike(refits: dict[str, float]) -> None:
    refits.update(leak=1000, air=3000)
    best, other = trial("leak", 1000), trial("air", 990)
    chosen, rest = contest(state(), present(5000), best, [best, other], {})
    assert (chosen.key, chosen.gain, rest) == (("air", "a"), 3000, ())


def test_of_equals_the_one_with_the_fewest_parameters(refits: dict[str, float]) -> None:
    best, other = trial("relief", 1000, 1.0, 2.0), trial("leak", 995)
    chosen, rest = contest(state(), present(5000), best, [best, other], {})
    assert chosen.key == ("leak", "a")
    assert rest == (("relief", "a"),)


def test_what_was_refitted_beside_the_same_fit_is_not_refitted_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refitted: list[str] = []

    def finished_(_state: Any, _present: Any, t: Trial) -> Trial:
        refitted.append(t.key[0])
        return t

    monkeypatch.setattr(module, "_finished", finished_)
    leak, air, sag = trial("leak", 1000), trial("air", 998), trial("sag", 996)
    finished: dict[Key, Trial] = {}
    for best, *rivals in ([leak, air, sag], [air, sag], [sag, leak]):
        contest(state(), present(5000), best, [best, *rivals], finished)
    assert refitted == ["leak", "air", "sag"]


def test_a_line_that_explains_less_than_what_it_stores_is_no_equal_of_it(
    refits: dict[str, float],
) -> None:
    """One that has a dead volume in it explains as much, whatever its inertia is."""
    volume, leak = (trial(name, 1000, 0.0) for name in ("extra_dead_volume", "leak"))
    line, other = (trial(name, 990, 1.0, 2.0, 3.0) for name in ("line_dynamics", "sag"))
    for gain, equals in ((1000 - TIE + 1, {line.key}), (1000 - TIE - 1, set())):
        refits.update(line_dynamics=gain)
        chosen, rest = contest(state(), present(5000), volume, [volume, line], {})
        assert (chosen.key, set(rest)) == (volume.key, equals)
    refits.update(sag=1000 - TIE - 1)  # what is no part of the other says nothing of it
    assert set(contest(state(), present(5000), leak, [leak, line, other], {})[1]) == {
        line.key, other.key,
    }  # fmt: skip


def late(effect: str, sse: float) -> Trial:
    """A timing that wins by 1000 less what it leaves, and what its moduli let in of the noise."""
    fit: Any = SimpleNamespace(held=SimpleNamespace(sse=sse), excess=sse - DOF)
    revision: Any = SimpleNamespace(timings=[(effect, (1e-3,))])
    return Trial((effect, "a"), 1000.0, revision, fit=fit, is_timing=True)


def test_times_are_compared_by_what_they_explain(monkeypatch: pytest.MonkeyPatch) -> None:
    """A position that is late wins by the oil beside it alone: a command may be late as well."""
    monkeypatch.setattr(module, "_finished", lambda _state, _present, t: t)
    position = replace(late("position", DOF + 20.0), gain=3000.0)
    command, worse = late("command", DOF), replace(late("worse", DOF + 500.0), gain=2000.0)
    trials = [position, replace(command, gain=1800.0), worse, trial("leak", 900.0)]
    chosen, alike_to_it = contest(state(), present(4000), position, trials, {})
    assert chosen.key[0] == "command", "it leaves least"
    assert [name for name, _ in alike_to_it] == ["position"]


@pytest.mark.parametrize(("by_form", "beside"), [(True, {("air", "a")}), (False, set())])
@pytest.mark.usefixtures("refits")
def test_what_is_not_told_from_a_refuted_one_has_its_turn(by_form: bool, beside: set[Key]) -> None:
    """The right form of the refuted law may fit as well; beside an impossible oil it does not."""
    air, gas, far = trial("air", 1000, 1.0), trial("gas", 985, 1.0), trial("hose", 900, 1.0)
    refuted = {air.key: by_form}
    chosen, alike = its_turn(state(), present(5000), gas, [air, gas, far], {}, refuted)
    assert chosen.key == gas.key and set(alike) == beside
    line = trial("line", 990, 1.0)
    both = [air, line, gas, far]
    _, alike = its_turn(state(), present(5000), gas, both, {}, refuted | {line.key: True})
    assert set(alike) == beside | {line.key}, "each of them that its own form alone refutes"
    chosen, _ = its_turn(state(), present(5000), far, [air, gas, far], {}, refuted)
    assert chosen.key == air.key, "one that is told from it has none"


def test_what_explains_more_and_was_passed_over_stays_beside_what_is_named() -> None:
    """A hose of 541 was not stable and so too little to matter: the cavitation of 297 was alone."""
    ended = [replace(trial(f"cause {k}", g), has_ended=True) for k, g in enumerate((541, 297, 305))]
    finished = {t.key: t for t in ended}
    found = passed_over(state("cause 0", "cause 2"), ended[1], finished)
    assert found == (ended[0].key,)
    assert passed_over(state(), ended[1], finished) == ()


def test_what_ended_better_outdoes_what_leaves_a_misfit() -> None:
    """Derivatives had promised the true leak 3 % less than a hysteresis that stood in for it."""
    play, leak, near = trial("play", 3307e3), trial("leak", 3320e3), trial("near", 3307e3 + TIE)
    finished = {t.key: t for t in (play, leak, near)}
    none = frozenset[Key]()
    assert outdone_by(state(), play, finished, none) is leak
    assert outdone_by(state(), leak, finished, none) is None
    assert outdone_by(state(), play, finished, {leak.key}) is None, "by no more than a tie"
    assert outdone_by(state("leak"), play, finished, none) is None, "it was too little"
    assert outdone_by(state(), play, finished, {play.key}) is None, "the other was refuted"


@pytest.mark.usefixtures("refits")
def test_what_has_outdone_another_one_is_taken_itself() -> None:
    """Of equals the one with fewer numbers is: a delay, again, that second order had outdone."""
    delay, second = (
        trial("delay", 985, 1.0),
        replace(trial("second", 1000, 1.0, 2.0), has_ended=True),
    )
    both, finished = [delay, second], dict[Key, Trial]()
    chosen, _ = its_turn(state(), present(5000), second, both, finished, {})
    assert chosen.key == delay.key
    chosen, alike = its_turn(state(), present(5000), second, both, finished, {}, {delay.key})
    assert (chosen.key, alike) == (second.key, (delay.key,))


@pytest.mark.parametrize(("behind", "is_alike"), [(0.5 * TIE, True), (1.1 * TIE, False)])
def test_a_relief_valve_that_ends_behind_a_leak_never_shuts(
    monkeypatch: pytest.MonkeyPatch, behind: float, is_alike: bool
) -> None:
    """It is the leak at an end of its form, 13 of chi2 behind: a set of four was told of three."""
    leak = trial("external_leakage_laminar", 1000.0)
    poppet = trial("relief_valve", 1000.0 - behind, 2e6, 0.0, 0.0)
    monkeypatch.setattr(module, "_all_finished", lambda *a: a[2])
    _, rivals = contest(state(), present(5000), leak, [leak, poppet], {})
    assert (poppet.key in rivals) is is_alike


def test_what_a_poppet_is_that_never_shuts_is_what_its_page_cannot_be_told_from() -> None:
    assert leaks_at("b") == {("external_leakage_laminar", "b")}
    assert poppets_at("b") == {("relief_valve", "b")}
