"""A force over a velocity, with friction that builds up over a way: random dampers, and another's.

F = -c v - d tanh(v / v_d) + F_h z,     dz/dt = v / x_h (1 - z sgn v)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rtid.effects.laws.friction import built_up, stroke_of
from rtid.plain import FloatArray
from rtid.project import ProjectError, load
from rtid.study.quick_rate import QuickRate, quick_rate
from rtid.study.study import Study
from rtid.trace.quick_source import open_source
from tests.replays import shared_replays  # noqa: F401
from tests.test_rate import said

STRANGERS = Path(__file__).parents[2] / "shared/data/strangers"
HZ = 200.0


@dataclass(frozen=True)
class Damper:
    """Viscous and limited force, friction and the way over which it builds up, SI."""

    viscous: float
    limited: float
    bend: float
    friction: float
    way: float
    noise: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Damper:
        low, high = [50, 5, 0.03, -60, 1e-3, 0.3], [300, 30, 0.1, -20, 4e-3, 1.5]
        return cls(*(float(x) for x in rng.uniform(low, high)))

    def recorded(self, path: Path, rng: np.random.Generator, seconds: float = 40.0) -> Path:
        """A table of v in cm/s and F in N: strokes of any length between 5 and 25 mm."""
        fine, n = 10, round(HZ * seconds)
        t = np.arange(n * fine) / (HZ * fine)
        pace = 2 * np.pi * np.cumsum(np.interp(t, *_points(rng, seconds, 0.8, 2.5))) / (HZ * fine)
        v = np.interp(t, *_points(rng, seconds, 0.04, 0.16)) * np.sin(pace)
        force = -self.viscous * v - self.limited * np.tanh(v / self.bend)
        force += self.friction * built_up(v, np.diff(t), self.way)
        force = force[::fine] + self.noise * rng.standard_normal(n)
        rows = np.column_stack([t[::fine], 100 * v[::fine], force])
        np.savetxt(path, rows, "%.6g", ",", header="t_s,v_cm_s,F_N", comments="")
        return path


def _points(
    rng: np.random.Generator, seconds: float, low: float, high: float
) -> tuple[FloatArray, FloatArray]:
    """Values at every second or so, between which to go."""
    count = round(seconds) + 1
    return np.linspace(0, seconds, count), rng.uniform(low, high, count)


def looked_at(table: Path) -> QuickRate:
    return quick_rate(table, open_source(table, None), {})


@pytest.mark.first_of(1)
@pytest.mark.parametrize("seed", range(2))
def test_the_loop_of_a_force_is_named(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng([31, seed])
    damper = Damper.drawn(rng)
    quick = looked_at(damper.recorded(tmp_path / "damper.csv", rng))
    (found,) = quick.diagnosis.found
    print(damper, found)
    assert (found.effect, found.cannot_be_told_from) == ("dahl_friction", ())
    assert found.parameters["force"].value == pytest.approx(damper.friction, rel=0.1)
    assert found.parameters["way"].value == pytest.approx(damper.way, rel=0.15)
    assert found.heldout_residual_after_m3s < 0.2 * found.heldout_residual_before_m3s


def test_a_force_without_a_loop_is_none(tmp_path: Path) -> None:
    rng = np.random.default_rng(32)
    damper = Damper(**(vars(Damper.drawn(rng)) | {"friction": 0.0}))
    quick = looked_at(damper.recorded(tmp_path / "damper.csv", rng))
    assert quick.diagnosis.verdict == "matches" and not quick.diagnosis.found


def test_friction_builds_up_over_its_way() -> None:
    """Exactly, whatever the steps; a reversal turns it round over the same way."""
    dt_s, v = np.full(1000, 1e-3), np.concatenate([np.full(501, 0.1), np.full(500, -0.1)])
    z = built_up(v, dt_s, 0.01)
    assert z[500] == pytest.approx(1 - np.exp(-0.05 / 0.01), rel=1e-9)
    assert z[-1] == pytest.approx(-1 + (1 + z[500]) * np.exp(-0.05 / 0.01), abs=0.02)
    np.testing.assert_allclose(built_up(v[::10], 10 * dt_s[::10], 0.01)[:50], z[:500:10], atol=1e-9)
    assert stroke_of(v, dt_s) == pytest.approx(0.1, rel=0.01)


def test_what_is_no_command_has_a_grid_of_its_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(33)
    table = Damper.drawn(rng).recorded(tmp_path / "damper.csv", rng, 20.0)
    said("init", table, "-o", tmp_path / "damper.toml")
    text = (tmp_path / "damper.toml").read_text()
    assert "\ngrid = [" in text and load(tmp_path / "damper.toml").model.measured == "x"
    for wrong in ("\nu_grid_v = [", "\nu_grid_v = [0, 1]\ngrid = ["):
        (tmp_path / "wrong.toml").write_text(text.replace("\ngrid = [", wrong))
        with pytest.raises(ProjectError, match=r"maps\.f"):
            load(tmp_path / "wrong.toml")


@pytest.mark.skipif(not STRANGERS.is_dir(), reason="no measurements of others beside this tree")
def test_a_stranger_s_damper(tmp_path: Path) -> None:
    """The first half teaches, the second judges: 30.7 N without the loop."""
    table = STRANGERS / "mr_damper.csv"
    quick = looked_at(table)
    assert [found.effect for found in quick.diagnosis.found] == ["dahl_friction"]
    (tmp_path / "damper.toml").write_text(quick.text)
    held_out = Study(tmp_path / "damper.toml", table).standing.held_out
    assert held_out.rms_m3s < 11.0
