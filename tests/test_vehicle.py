"""A car's acceleration over pedal and speed, from ten minutes of driving on hills, as two tables.

dv/dt = f(u, v) - g sin(grade),   u: pedal, brake below zero, late by 0.1 to 0.3 s
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtid.diagnose.report import FoundEffect
from rtid.errors import RtidError
from rtid.estimator.flowmap import EXTRAPOLATED, VALID, EdgeMap, FlowMap
from rtid.maps.files import write_map
from rtid.maps.pedals import CELLS, pedal_table
from rtid.model import Grid
from rtid.plain import FloatArray
from rtid.study.study import Study
from tests.replays import shared_replays  # noqa: F401
from tests.test_rate import said

HZ, INNER, MINUTES, GRAVITY = 30.0, 4, 10, 9.80665
OFF = "behind four points in rms, 1.13 for 1.06 %: one block, refused, is 2.2 sd off"
PROJECT = """
[project]
name = "car"
[source]
time_column = "t_s"
[signals.u]
column = "u_pct"
unit = "%"
[signals.v]
column = "v_mps"
unit = "m/s"
noise = "estimate"
resolution = 0.01
range = [0.3, 40]
[signals.grade]
column = "grade_rad"
unit = "rad"
kind = "other"
[rate]
state = "v"
[maps.f]
command = "u"
u_grid_pct = [-75, -40, -20, -7, 7, 20, 40, 65, 98]
over = "v"
over_grid = [0, 1.5, 3, 7, 12, 20]
rated = 3
basis = "blended"
[effects.grade]
flow = "-9.80665 * grade"
unit = "1"
chambers = {v = 1}
largest = 10
[filter]
natural_frequency_hz = 3
rows_per_s = 30
[gates]
max_gap_ms = 200
max_sd_share = 0.03
"""


@dataclass(frozen=True)
class Car:
    """Drive, brake, creep and drag of a car; its pedals act so many s late."""

    drive: float
    fading: float
    bend: float
    brake: float
    grip: float
    roll: float
    creep: float
    drag: float
    delay_s: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Car:
        low = np.array([3.0, 12.0, 1.1, 5.0, 1.1, 0.1, 0.2, 3e-4, 0.1])
        high = np.array([4.5, 20.0, 1.5, 8.0, 1.6, 0.25, 0.5, 8e-4, 0.3])
        return cls(*(float(x) for x in rng.uniform(low, high)))

    def acceleration(self, u: Any, v: Any) -> Any:
        """m/s2 on the flat, of pedals in per cent and speeds in m/s."""
        throttle, brake = np.maximum(u, 0) / 100, np.maximum(-np.asarray(u), 0) / 100
        driven = self.drive * throttle**self.bend / (1 + v / self.fading)
        drag = self.roll - self.creep * np.exp(-v / 1.5) + self.drag * v * v
        return driven - self.brake * brake**self.grip - drag

    def driven(self, path: Path, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Ten minutes in a town on hills as a table; pedal (n,), %, and speed (n,), m/s."""
        n, legs = round(60 * MINUTES * HZ), round(5 * MINUTES)
        t_s, leg = np.arange(n) / HZ, np.arange(n) * legs // n
        grade = 0.04 * np.sin(2 * np.pi * t_s / 97) + 0.02 * np.sin(2 * np.pi * t_s / 31 + 1)
        target = (rng.uniform(0, 16, legs) * (rng.random(legs) > 0.1))[leg]
        eager, tremble = rng.uniform(5, 22, legs)[leg], rng.normal(0, 3, n)
        h, u, v, pull = 1 / (HZ * INNER), 0.0, 0.0, 0.0
        sent, pedal, speed = [0.0] * (1 + round(self.delay_s / h)), np.zeros(n), np.zeros(n)
        late = len(sent)
        for k in range(n):
            pull = min(max(pull + 0.05 * (target[k] - v), -20.0), 20.0)
            wish = eager[k] * (target[k] - v) + pull + tremble[k]
            u += (min(max(wish, -70.0), 95.0) - u) / (0.35 * HZ)
            pedal[k], speed[k] = u, v
            for _ in range(INNER):
                sent.append(u)
                a = self._one(sent[-late], v) - GRAVITY * np.sin(grade[k])
                v = max(0.0, v + h * a)
        rows = np.column_stack([
            t_s, pedal, np.round((speed + 0.02 * rng.standard_normal(n)) / 0.01) * 0.01,
            grade + 0.002 * rng.standard_normal(n),
        ])  # fmt: skip
        head = "t_s,u_pct,v_mps,grade_rad"
        np.savetxt(path, rows, ["%.4f", "%.1f", "%.2f", "%.5f"], ",", header=head, comments="")
        return np.round(pedal, 1), speed

    def _one(self, u: float, v: float) -> float:
        return float(self.acceleration(u, v))


def cells_of(u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pedals and speeds at the centres of the cells with 20 samples or more; the car moves."""
    at_u, at_v = np.arange(-75, 101, 5.0), np.arange(0.5, 18, 1.0)
    count = np.histogram2d(u, v, [at_u, at_v])[0]
    i, j = np.nonzero(count >= 20)
    return 0.5 * (at_u[i] + at_u[i + 1]), 0.5 * (at_v[j] + at_v[j + 1])


def four_points(table: Path, w: FloatArray, v: FloatArray) -> FloatArray:
    """The baseline at points (n,): least squares over the four nodes around each sample.

    The acceleration is the differenced speed less the grade's, the delay is not known.
    """
    t_s, u, speed, grade = np.loadtxt(table, delimiter=",", skiprows=1).T
    half = 5
    a = np.zeros(len(t_s))
    a[half:-half] = (speed[2 * half :] - speed[: -2 * half]) / (2 * half / HZ)
    moving, a = speed > 0.3, a + GRAVITY * grade
    nodes = np.arange(-75.0, 101, 12.5), np.arange(0.0, 21, 2.5)
    phi = _bilinear(nodes, u[moving], speed[moving])
    held, none = 0.1 * np.eye(phi.shape[1]), np.zeros(phi.shape[1])
    theta = np.linalg.lstsq(np.vstack([phi, held]), np.append(a[moving], none), rcond=None)[0]
    return np.asarray(_bilinear(nodes, w, v) @ theta)


def _bilinear(nodes: tuple[FloatArray, FloatArray], u: FloatArray, v: FloatArray) -> FloatArray:
    hats = [
        np.stack([np.interp(x, n, hat) for hat in np.eye(len(n))], axis=1)
        for n, x in zip(nodes, (u, v), strict=True)
    ]
    return np.einsum("ni,nj->nij", *hats).reshape(len(u), -1)


@pytest.mark.slow  # ten minutes of driving are diagnosed and fitted
@pytest.mark.parametrize(
    "seed",
    [
        0,
        pytest.param(1, marks=pytest.mark.long),
        pytest.param(2, marks=[pytest.mark.long, pytest.mark.xfail(strict=True, reason=OFF)]),
    ],
)
def test_ten_minutes_of_driving_are_a_map(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng([26, seed])
    car, table, project = Car.drawn(rng), tmp_path / "drive.csv", tmp_path / "car.toml"
    pedal, speed = car.driven(table, rng)
    project.write_text(PROJECT)
    named = Study(project, table).diagnosis().found
    assert [effect.effect for effect in named] == ["grade", "input_delay"]
    assert named[0].parameters["coefficient"].value == pytest.approx(1.0, abs=0.05)
    project.write_text(PROJECT + "".join(_added(effect) for effect in named))
    study = Study(project, table)
    (delay,) = (e.parameters["delay"].value for e in study.effects if e.effect == "input_delay")
    assert delay == pytest.approx(car.delay_s, abs=0.01)
    w, v = cells_of(pedal, speed)
    truth, learned = car.acceleration(w, v), study.map["f"]
    scale = float(np.ptp(truth))
    errors = np.abs(learned.flow(w, v) - truth) / scale
    plain = np.abs(four_points(table, w, v) - truth) / scale
    known = learned.sd(w, v) < 0.03 * scale
    of_range = [(100 * np.sqrt(np.mean(e**2)), 100 * np.quantile(e, 0.95)) for e in (errors, plain)]
    print(len(w), "cells,", known.mean(), "known; rms and 95 %, of four points too:", of_range)
    assert known.mean() > 0.6
    assert np.quantile(errors[known], 0.95) < 0.03
    assert np.square(errors[known]).mean() < np.square(plain[known]).mean()
    assert of_range[0] < of_range[1]
    said("export", table, tmp_path / "accel_map.csv", "-p", project)
    _read_as_autoware_does(tmp_path, study.map)


def _added(effect: FoundEffect) -> str:
    """What `rtid add` writes of it: both at once, which saves a fit."""
    ((name, size),) = effect.parameters.items()
    head = f'[[added]]\neffect = "{effect.effect}"\nwhere = "{effect.where}"\n'
    return head + f'parameters = {{{name} = {{value = {size.value}, unit = "{size.unit}"}}}}\n'


def _read_as_autoware_does(folder: Path, learned: FlowMap) -> None:
    """First row `default` and speeds, pedal in the first column, monotone in the pedal."""
    tops = []
    for name, sign in (("accel_map.csv", 1), ("brake_map.csv", -1)):
        first, *rows = csv.reader((folder / name).read_text().splitlines())
        assert first[0] == "default"
        speed, body = np.array(first[1:], float), np.array(rows, float)
        assert (np.diff(speed) > 0).all() and (np.diff(body[:, 0]) > 0).all()
        assert body[0, 0] == 0.0 and body[-1, 0] <= 1.0
        assert (sign * np.diff(body[:, 1:], axis=0) >= -1e-9).all()
        tops.append(body[0, 1:])
        inside = learned["f"].flow(100 * sign * body[1:-1, :1], speed[None, 1:-1])
        assert np.median(np.abs(body[1:-1, 2:-1] - inside)) < 0.02
    np.testing.assert_array_equal(tops[0], tops[1])
    assert "reason" in (folder / CELLS).read_text().splitlines()[0]


def test_what_is_bent_or_not_known_is_listed(tmp_path: Path) -> None:
    """A dip is taken out, a hole is filled from its own speed, and both are said."""
    grid = Grid(np.array([-100.0, -50.0, 0.0, 50.0, 100.0]), np.array([0.0, 5.0, 10.0, 20.0]))
    theta = np.zeros((*grid.shape, 6))
    theta[:, :, 0] = np.array([-6.0, -2.0, 1.0, 3.0])[:, None]
    theta[3, 0, 0], status = 0.5, np.full(grid.shape, VALID)
    status[2:, 2] = EXTRAPOLATED
    edge = EdgeMap(
        "f", grid, -np.inf, theta, np.zeros((*grid.shape, 6, 6)), status, {(3, 2): "few"}
    )
    table = pedal_table(FlowMap((edge,)))
    assert (np.diff(table.written, axis=0) >= -1e-12).all()
    assert {"", "made monotone in the pedal", "few"} <= set(table.reason.ravel().tolist())
    assert np.isfinite(table.written).all()
    with pytest.raises(RtidError, match=r"in m/s2 only|the map is in m3/s"):
        write_map(tmp_path / "accel_map.csv", FlowMap((edge,)), {})
    with pytest.raises(RtidError, match="signed pedal"):
        pedal_table(FlowMap((edge, edge)))
