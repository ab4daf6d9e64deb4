"""A force that a pressure gives, with friction beside it: cylinders drawn at random, and another's.

F = A p + (F_c + C p) sign(v) + b v
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import savgol_filter

from firmware_bridge.sources import read_table
from rtid.estimator.estimator import Estimator
from rtid.plain import FloatArray
from rtid.project import load
from rtid.study.on_board import learned_sizes, on_board
from rtid.study.quick import quick
from rtid.study.quick_rate import QuickRate
from rtid.study.study import Study
from rtid.trace.reading import read_trace
from tests.replays import shared_replays  # noqa: F401
from tests.test_rate import said

STRANGERS = Path(__file__).parents[2] / "shared/data/strangers"
HZ = 100.0
COULOMB, PRESSED, VISCOUS = (
    "coulomb_on_output", "coulomb_on_output_over_pressure", "viscous_on_output",
)  # fmt: skip


@dataclass(frozen=True)
class Pulled:
    """A cylinder on a stand: area, friction of three kinds, noise of the force, SI."""

    area: float
    coulomb: float
    pressed: float
    viscous: float
    noise: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Pulled:
        """Friction of 3 to 10 % of the force at 2 bar, a third to a half of it by pressure."""
        area = float(rng.uniform(2e-4, 2e-3))
        whole = float(rng.uniform(0.03, 0.1) * rng.choice([-1, 1])) * area * 2e5
        share = float(rng.uniform(0.3, 0.5))
        coulomb, pressed = (1.0 - share) * whole, share * whole / 2e5
        return cls(area, coulomb, pressed, 0.0, 0.002 * area * 2e5)

    @property
    def alone(self) -> Pulled:
        """The same without friction."""
        return replace(self, coulomb=0.0, pressed=0.0, viscous=0.0)

    def recorded(self, path: Path, rng: np.random.Generator, pressure_bar: float) -> Path:
        """A table of 60 s: x in mm, p in bar, F in N; strokes there and back at several speeds."""
        n = round(60 * HZ)
        speeds = np.concatenate([rng.uniform(3, 30, 1) * sign for sign in [1, -1] * 20])
        rest = np.zeros(round(0.3 * HZ))
        strokes = [np.append(np.full(max(2, round(20 * HZ / abs(s))), s), rest) for s in speeds]
        v = 1e-3 * np.concatenate(strokes)[:n]
        p = 1e5 * pressure_bar + 2e3 * np.cumsum(rng.standard_normal(n)) / np.sqrt(n)
        force = self.area * p + (self.coulomb + self.pressed * p) * np.sign(v) + self.viscous * v
        force += self.noise * rng.standard_normal(n)
        x = 10 + 1e3 * np.cumsum(v) / HZ + 0.005 * rng.standard_normal(n)
        rows = np.column_stack([1e3 * np.arange(n) / HZ, x, 1e-5 * p, force])
        head = "t_ms,x_mm,p_bar,F_N"
        np.savetxt(path, rows, "%.7g", ",", header=head, comments="")
        return path


def looked_at(plant: Pulled, folder: Path, rng: np.random.Generator) -> QuickRate:
    """What quick tells of three records, of which the one at the highest pressure judges."""
    tables = [plant.recorded(folder / f"at_{p}_bar.csv", rng, p) for p in (1, 3, 5)]
    looked = quick(tables[0], more=tables[1:])
    assert isinstance(looked, QuickRate) and looked.pair.pressed
    return looked


def named(looked: QuickRate) -> dict[str, Any]:
    """The effects that are named, by their names."""
    print(looked.pair.equation, looked.bands, looked.diagnosis.found)
    return {found.effect: found for found in looked.diagnosis.found}


@pytest.mark.first_of(1)
@pytest.mark.parametrize("seed", range(2))
def test_friction_that_grows_with_pressure_is_named(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng([51, seed])
    plant = Pulled.drawn(rng)
    looked = looked_at(plant, tmp_path, rng)
    found = named(looked)
    assert found.keys() == {COULOMB, PRESSED} and looked.diagnosis.verdict == "missing"
    for effect, truth in ((COULOMB, plant.coulomb), (PRESSED, plant.pressed)):
        (size,) = found[effect].parameters.values()
        assert size.std is not None and 3.0 * size.std < 0.2 * abs(truth)
        assert abs(size.value - truth) < 3.0 * size.std
    assert looked.bands["f"].gain_above == pytest.approx(plant.area, rel=0.003)
    assert looked.ranges["f"][1] < 6.1e5


@pytest.mark.parametrize("seed", range(2))
def test_a_pressure_alone_has_no_friction(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng([52, seed])
    looked = looked_at(Pulled.drawn(rng).alone, tmp_path, rng)
    assert not named(looked) and looked.diagnosis.verdict == "matches"


@pytest.mark.long
def test_friction_of_one_kind_is_not_taken_for_another(tmp_path: Path) -> None:
    rng = np.random.default_rng(53)
    drawn = Pulled.drawn(rng)
    kinds = {
        COULOMB: replace(drawn.alone, coulomb=drawn.coulomb),
        PRESSED: replace(drawn.alone, pressed=2.0 * drawn.pressed),
        VISCOUS: replace(drawn.alone, viscous=drawn.coulomb / 0.02),
    }
    for kind, plant in kinds.items():
        found = named(looked_at(plant, tmp_path, rng))
        assert found.keys() == {kind} and not found[kind].cannot_be_told_from


def test_friction_is_learned_on_board(tmp_path: Path) -> None:
    """Beside the maps, sample by sample, of a position that is no state of the plant."""
    rng = np.random.default_rng(54)
    plant = Pulled.drawn(rng)
    looked = looked_at(plant, tmp_path, rng)
    file = tmp_path / "pulled.toml"
    file.write_text(looked.text_for(file))
    words: list[str] = []
    board = on_board(load(file), words.append)
    assert len(words) == len(board.model.terms) == 2
    assert all("sample by sample" in w for w in words)
    samples = read_trace(board, tmp_path / "at_3_bar.csv").samples
    estimator = Estimator(board.model)
    estimator.update(samples)
    learned = learned_sizes(board, estimator.solution())
    for (name, value, sd, unit), truth in zip(learned, (plant.coulomb, plant.pressed), strict=True):
        print(name, value, sd, unit, truth)
        assert abs(value - truth) < max(4.0 * sd, 0.05 * abs(truth)) and unit[0] == "N"


def test_a_proportional_map_keeps_its_blocks(tmp_path: Path) -> None:
    """Halves of a block would have a gain each, with a step in the force between them."""
    rng = np.random.default_rng(55)
    plant = Pulled.drawn(rng)
    table = plant.recorded(tmp_path / "at_5_bar.csv", rng, 5)
    said("init", table, "-o", tmp_path / "pulled.toml")
    study = Study(tmp_path / "pulled.toml", table)
    assert [e.grid.shape for e in study.replay.fit.solution.model.edges] == [(1, 1)]


@pytest.mark.skipif(not STRANGERS.is_dir(), reason="no measurements of others beside this tree")
def test_a_stranger_s_seal(tmp_path: Path) -> None:
    """1 and 3 bar teach, 5 bar judges: 6.76 N by its area alone, where it moves."""
    tables = sorted(STRANGERS.glob("seal_oring_*.csv"))
    looked = quick(tables[0], more=tables[1:], held_out=["*5bar*"])
    assert isinstance(looked, QuickRate)
    found = looked.diagnosis.found
    assert [f.effect for f in found] == [COULOMB, PRESSED]
    assert not any(f.cannot_be_told_from for f in found)
    (coulomb,), (pressed,) = (f.parameters.values() for f in found)
    p, v, force = _moving(tables[2])
    left = force - looked.bands["f"].gain_above * p
    friction = (coulomb.value + pressed.value * p) * np.sign(v)
    print(np.std(left), _rms(left - friction), [e.left for e in looked.errors])
    assert _rms(left - friction) < 1.8
    steps = [found[0].heldout_residual_before_m3s, *(f.heldout_residual_after_m3s for f in found)]
    assert steps[0] > 6.0 and steps[1] < 2.4 and steps[2] < 1.8
    assert looked.errors[-1].is_held_out and looked.errors[-1].left < 1.8


def _moving(table: Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pressure, velocity and force at an even 20 Hz where 1 < |v| < 100 mm/s, SI."""
    columns = read_table(table).columns
    t_s = 1e-3 * columns["t_ms"]
    even = np.arange(t_s[0], t_s[-1], 0.05)
    x, p, force = (np.interp(even, t_s, columns[k]) for k in ("x_mm", "p_bar", "F_N"))
    v = savgol_filter(x, 9, 2, deriv=1, delta=0.05)
    here = (np.abs(v) > 1) & (np.abs(v) < 100)
    return 1e5 * p[here], 1e-3 * v[here], force[here]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
