"""How many causes a round looks at that change next to nothing, before it gives up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rtid.diagnose import one_round
from rtid.diagnose.one_round import MOST_NEGLIGIBLE, add_best
from rtid.diagnose.trials import Trial
from rtid.plain import Key

LEAK: Key = ("external_leakage_laminar", "a")
LITTLE: tuple[Key, ...] = tuple(
    (effect, "a")
    for effect in ("extra_dead_volume", "hose_compliance", "entrained_air", "line_dynamics")
)


def judged(
    monkeypatch: pytest.MonkeyPatch, gains: dict[Key, float], known: tuple[Key, ...] = ()
) -> tuple[Any, list[Key]]:
    """What a round adds where a leak alone is material, and the causes whose turn it was.

    gains: of the causes on trial, chi2; known: those that earlier rounds have put aside.
    """
    turns: list[Key] = []
    trials: list[Any] = [SimpleNamespace(key=key, gain=gain) for key, gain in gains.items()]
    state: Any = SimpleNamespace(
        found=[], given=(), ruled_out=set(), negligible=dict.fromkeys(known, 1e-4)
    )

    def its_turn(_: Any, present: Any, best: Trial, *__: Any) -> tuple[Trial, tuple[Key, ...]]:
        turns.append(best.key)
        return best, ()

    def taken(_: Any, __: Trial, trial: Trial, *___: Any) -> str:
        return f"with {trial.key[0]}"

    always: dict[str, Any] = {
        "trials_of": trials, "its_turn": None, "explains_enough": True, "carried_on": None,
        "with_covariances": None, "is_refuted": False, "ended": None, "is_within_a_form": False,
        "is_seen_to_harm": False, "taken_in": None, "is_as_credible": False, "own_share": 1.0,
    }  # fmt: skip
    for name, value in always.items():
        monkeypatch.setattr(one_round, name, lambda *_, _value=value, **__: _value)
    monkeypatch.setattr(one_round, "its_turn", its_turn)
    monkeypatch.setattr(one_round, "material_share", lambda *_: 1.0 if turns[-1] == LEAK else 0.0)
    monkeypatch.setattr(one_round._Round, "_taken", taken)
    state.left = lambda _: None
    last: Any = None
    return add_best(state, last, last), turns


@pytest.mark.parametrize("n_known", range(len(LITTLE) + 1))
def test_what_was_put_aside_before_leaves_the_next_rounds_their_turns(
    monkeypatch: pytest.MonkeyPatch, n_known: int
) -> None:
    """A volume that changes next to nothing, and three causes like it, used up all four places."""
    gains = {LEAK: 5000.0, **dict.fromkeys(LITTLE, 6000.0)}
    added, turns = judged(monkeypatch, gains, LITTLE[:n_known])
    is_within = len(LITTLE) - n_known < MOST_NEGLIGIBLE
    assert added == (f"with {LEAK[0]}" if is_within else None)
    assert (LEAK in turns) == is_within


def test_a_round_looks_at_few_that_change_next_to_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """With those of five from before too, where nothing limited it any more."""
    more: dict[Key, float] = {("cause", str(k)): 1000.0 + k for k in range(9)}
    added, turns = judged(monkeypatch, more, (*LITTLE, ("cavitation", "a")))
    assert added is None
    assert turns == [("cause", str(k)) for k in (8, 7, 6, 5)]
