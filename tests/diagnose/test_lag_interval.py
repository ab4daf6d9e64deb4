"""A lag is known as well as others leave more: not as a derivative at one says."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.diagnose import lag_interval
from rtid.diagnose.lag_interval import RISE, LagInterval, known_lag
from rtid.diagnose.revision import Revision
from rtid.effects.laws.timing import delayed
from rtid.model import Lag

LAG_S, SD_S, RHO = 3e-3, 1e-4, 1.44
DELAY_S = 20e-3


def interval(
    monkeypatch: pytest.MonkeyPatch, excess: Callable[[float], float], local_s: float
) -> LagInterval:
    """How well a lag is known whose fits leave `excess` (s -> chi2), of a chamber that follows."""

    def passed(_model: Any, _chunk: Any, weights: Any, *_rest: Any, **_more: Any) -> Any:
        return SimpleNamespace(
            excess=excess(weights.lag_s), compliance=np.array([1e-9, 1e-9 + 1e-7 * weights.lag_s])
        )

    monkeypatch.setattr(lag_interval, "one_pass", passed)
    monkeypatch.setattr(lag_interval, "replace", lambda _, **changed: SimpleNamespace(**changed))
    declared = SimpleNamespace(lag=Lag(2e-3, 1e-3))
    present: Any = SimpleNamespace(
        weights=SimpleNamespace(lag_s=LAG_S), declared=declared, chunk=None, revision=Revision(),
        rho=RHO, excess=excess(LAG_S), lag_sd_s=local_s, lag_tolerance_s=1e-3,
        compliance=np.array([1e-9, 1e-9 + 1e-7 * LAG_S]),
    )  # fmt: skip
    return known_lag(present)


def told(
    monkeypatch: pytest.MonkeyPatch, excess: Callable[[float], float], local_s: float
) -> float:
    """The deviation of such a lag alone."""
    return interval(monkeypatch, excess, local_s).sd_s


def parabola(lag_s: float) -> float:
    return RHO * ((lag_s - LAG_S) / SD_S) ** 2


@pytest.mark.parametrize("local_s", [SD_S, 0.3 * SD_S])
def test_a_parabola_gives_its_own(monkeypatch: pytest.MonkeyPatch, local_s: float) -> None:
    sd_s = told(monkeypatch, parabola, local_s)
    assert sd_s == pytest.approx(SD_S, rel=0.05 if local_s == SD_S else 0.2)


def test_a_modulus_is_known_no_better_than_the_lag_that_it_goes_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Beside 2.84 +- 0.42 ms 1116 +- 40 MPa were told, of 1458: it went by 790 MPa a ms."""
    apart, with_it = interval(monkeypatch, parabola, 0.3 * SD_S).compliance
    assert apart == 0.0 and with_it == pytest.approx(1e-7 * SD_S, rel=0.2)
    assert not interval(monkeypatch, parabola, SD_S).compliance.any(), "its derivative counts it"


def test_what_is_level_is_known_to_its_range(monkeypatch: pytest.MonkeyPatch) -> None:
    """0 to 5 ms: from three tolerances below what is declared, and no less than none, to above."""
    sd_s = told(monkeypatch, lambda _: 0.0, SD_S)
    assert sd_s == pytest.approx(5e-3 / (2.0 * RISE))


def test_at_an_end_of_its_range_it_is_as_little_known_beyond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """5.66 +- 0.67 ms were told at three tolerances, of 3.54: the half of what is left open."""
    monkeypatch.setattr(lag_interval, "LAG_REACH", 1.0)  # 2 + 1 ms: it stands there
    assert told(monkeypatch, parabola, SD_S) == pytest.approx(SD_S, rel=0.05)
    level = told(monkeypatch, lambda lag_s: 0.0 if lag_s > LAG_S - 1.5e-3 else 1e3, SD_S)
    assert level == pytest.approx(1.5e-3 / RISE, rel=0.3)


def test_another_hollow_is_in_its_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """1.83 +- 0.03 ms were told of 1.13, which left less, beyond a rise of 20."""

    def hollows(lag_s: float) -> float:
        return min(parabola(lag_s), parabola(lag_s + 8.0 * SD_S) - 30.0)

    sd_s = told(monkeypatch, hollows, 0.3 * SD_S)
    assert sd_s == pytest.approx((3.0 + 8.0 + 5.5) * SD_S / (2.0 * RISE), rel=0.25)


def test_it_is_never_less_than_the_derivative_says(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(monkeypatch, lambda lag_s: 100.0 * parabola(lag_s), SD_S) == SD_S


def test_a_lag_that_is_not_told_stays_so(monkeypatch: pytest.MonkeyPatch) -> None:
    sd_s = told(monkeypatch, parabola, float("nan"))
    assert sd_s != sd_s


def test_a_delay_is_known_as_well_as_with_the_lag_the_other_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their sum is known to SD_S, the delay itself ten times worse."""

    def passed(_model: Any, _chunk: Any, weights: Any, revision: Any, *_rest: Any, **_: Any) -> Any:
        ((_, (delay_s,)),) = revision.timings
        off = delay_s - DELAY_S, delay_s + weights.lag_s - DELAY_S - LAG_S
        excess = RHO * ((off[0] / (10 * SD_S)) ** 2 + (off[1] / SD_S) ** 2)
        return SimpleNamespace(excess=excess)

    monkeypatch.setattr(lag_interval, "one_pass", passed)
    monkeypatch.setattr(lag_interval, "replace", lambda _, **changed: SimpleNamespace(**changed))
    law = SimpleNamespace(low=(1e-4,), high=(0.1,), apply=delayed)
    present: Any = SimpleNamespace(
        weights=SimpleNamespace(lag_s=LAG_S), declared=SimpleNamespace(lag=Lag(2e-3, 5e-3)),
        chunk=None, revision=SimpleNamespace(timings=((law, (DELAY_S,)),)), rho=RHO, excess=0.0,
        lag_tolerance_s=5e-3, timing_columns=lambda _: range(4, 5),
        estimate=SimpleNamespace(sd=lambda _: SD_S / np.sqrt(RHO)),
    )  # fmt: skip
    beyond_s = lag_interval.timing_sd(present, 0)
    assert np.hypot(beyond_s, SD_S) == pytest.approx(10 * SD_S, rel=0.1)


def looking(
    monkeypatch: pytest.MonkeyPatch, excess: Callable[[float], float], steps_v: float
) -> float:
    """The lag to which a fit is led whose command jumps by so much, blocks being 0.5 V wide."""

    def at(lag_s: float) -> Any:
        return SimpleNamespace(
            weights=SimpleNamespace(lag_s=lag_s), excess=excess(lag_s), lag_sd_s=2e-5,
            lag_tolerance_s=5e-3, revision=Revision(), regression=SimpleNamespace(dof=6000.0),
            declared=machine, chunk=chunk, light=lambda: None,
        )  # fmt: skip

    edge = SimpleNamespace(command="u", grid=SimpleNamespace(u_v=np.arange(0.0, 5.0, 0.5)))
    machine = SimpleNamespace(edges=(edge,), column=lambda _: 0, lag=Lag(2e-3, 5e-3))
    chunk = np.zeros((50, 3))
    chunk[:, 2] = np.repeat(np.arange(10) % 2 * steps_v, 5)
    monkeypatch.setattr(lag_interval, "replace", lambda _, **changed: SimpleNamespace(**changed))
    passed = _fitted_at(at)
    monkeypatch.setattr(lag_interval, "one_pass", passed)
    monkeypatch.setattr(lag_interval, "fit", passed)
    return float(lag_interval.looked_over(at(6.8e-3)).weights.lag_s)


def _fitted_at(at: Callable[[float], Any]) -> Callable[..., Any]:
    def passed(_model: Any, _chunk: Any, weights: Any, *_: Any, **__: Any) -> Any:
        now = at(weights.lag_s)
        now.light = lambda: now
        return now

    return passed


def test_where_commands_jump_all_of_the_range_is_looked_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """6.812 +- 0.018 ms were told of 10.8, which left 320 less; by 50 less is uneven."""

    def bowl(deep: float) -> Callable[[float], float]:
        return lambda lag_s: deep * ((lag_s - 10.8e-3) / 4e-3) ** 2

    assert looking(monkeypatch, bowl(320.0), steps_v=4.0) == pytest.approx(10.8e-3, abs=0.8e-3)
    assert looking(monkeypatch, bowl(50.0), steps_v=4.0) == 6.8e-3
    assert looking(monkeypatch, bowl(320.0), steps_v=0.4) == 6.8e-3, "derivatives lead there"


@pytest.mark.parametrize("by_s", [-1e-3, 1e-3, 3e-3])
def test_a_play_beside_a_lag_out_of_its_range_is_as_wide_within(
    monkeypatch: pytest.MonkeyPatch, by_s: float
) -> None:
    """A lag of none is mirrored: nothing is fitted with a negative one."""
    asked = list[float]()

    def shared(_present: Any, _k: int, lag_s: float) -> Any:
        asked.append(lag_s)
        play = SimpleNamespace(revision=SimpleNamespace(timings=((None, (0.4 - 100.0 * lag_s,)),)))
        return play

    monkeypatch.setattr(lag_interval, "shared", shared)
    present: Any = SimpleNamespace(
        weights=SimpleNamespace(lag_s=0.0), lag_tolerance_s=1e-3,
        declared=SimpleNamespace(lag=Lag(0.0, 1e-3)),
        revision=SimpleNamespace(timings=((None, (0.4,)),)),
    )  # fmt: skip
    assert lag_interval._beside(present, 0, by_s) == pytest.approx(0.4 - 100.0 * by_s)
    assert asked == [abs(by_s)]
