"""Plants by their equations: an electric drive, two tanks, a propeller's thrust.

What is declared is a plant file as `rtid refit` takes it; what is hidden is simulated by fine
Euler steps.  Both records begin in the same state; what is predicted is the free run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.missing.record import SMALL, Case, Record, Truth, Wish
from rtid.plain import FloatArray
from rtid.project.plant_file import PlantFile, load_plant
from rtid.sim.other_plants import PLANT_FILES, moved, steps

N = 800
Simulate = Callable[[np.random.Generator, FloatArray, bool, dict[str, float]], FloatArray]

THRUST = """
[plant]
name = "thrust"
time_column = "t_s"
[inputs.u]
column = "u"
unit = "1"
[states.w]
rate = "(k*u - w)/tau"
quantity = "velocity"
unit = "krad/s"
start = 0
low = -1
high = 5
[outputs.y]
value = "c*w*abs(w)"
column = "y"
unit = "N"
[parameters.k]
start = 1
low = 0.1
high = 5
unit = "krad/s"
[parameters.tau]
start = 0.1
low = 0.01
high = 1
unit = "s"
[parameters.c]
start = 5
low = 0.5
high = 50
unit = "N/(krad/s)2"
"""


@dataclass(frozen=True)
class Kind:
    """One plant: its file's text, what is hidden, sampling, sensor noise, inputs and states."""

    text: Callable[[], str]
    hidden: str
    dt_s: float
    noise: float
    draw: Callable[[np.random.Generator], dict[str, float]]
    inputs: Callable[[np.random.Generator], FloatArray]
    step: Callable[[dict[str, float], FloatArray, float, float], FloatArray]
    start: tuple[float, ...]
    output: Callable[[dict[str, float], FloatArray], FloatArray]


def _example(name: str) -> Callable[[], str]:
    path = PLANT_FILES / f"{name}.toml"
    return path.read_text


def _drive(c: dict[str, float], x: FloatArray, u: float, h: float) -> FloatArray:
    x = x + h * (c["b"] * np.tanh(c["c"] * u) - c["a"] * x)
    return np.asarray(x - np.sign(x) * np.minimum(np.abs(x), h * c["hidden"]))


def _tanks(c: dict[str, float], x: FloatArray, u: float, h: float) -> FloatArray:
    """The upper tank spills over its rim, and a part of it lands in the lower one."""
    upper, lower = np.maximum(x, 0.0)
    out = c["k1"] * np.sqrt(upper)
    spilt = 0.5 * max(upper - c["rim"], 0.0) * c["hidden"]
    return np.array([upper + h * (c["k4"] * u - out - spilt),
                     lower + h * (out + 0.3 * spilt - c["k3"] * np.sqrt(lower))])  # fmt: skip


def _thrust(c: dict[str, float], x: FloatArray, u: float, h: float) -> FloatArray:
    """Hidden: the motor does not turn below a command."""
    acts = np.sign(u) * max(abs(u) - c["hidden"], 0.0)
    return np.asarray(x + h * (c["k"] * acts - x) / c["tau"])


def _uniform(**ranges: tuple[float, float]) -> Callable[[np.random.Generator], dict[str, float]]:
    return lambda rng: {name: float(rng.uniform(*ends)) for name, ends in ranges.items()}


KINDS = {
    "drive": Kind(
        _example("electric_drive"), "coulomb_friction", 0.01, 0.1,
        _uniform(a=(2, 5), b=(200, 320), c=(0.2, 0.35), hidden=(15, 40)),
        lambda rng: steps(rng, -6, 6, 40, N), _drive, (0.0,), lambda c, x: x[:, 0],
    ),
    "tanks": Kind(
        _example("cascaded_tanks"), "overflow", 4.0, 0.02,
        _uniform(k1=(0.04, 0.06), k3=(0.04, 0.06), k4=(0.04, 0.06), rim=(7, 9), hidden=(1, 1)),
        lambda rng: steps(rng, 0.5, 6.0, 25, N), _tanks, (5.0, 5.0), lambda c, x: x[:, 1],
    ),
    "thrust": Kind(
        lambda: THRUST, "dead_zone", 0.02, 0.02,
        _uniform(k=(0.7, 1.4), tau=(0.05, 0.2), c=(4, 8), hidden=(0.08, 0.2)),
        lambda rng: steps(rng, -1, 1, 30, N), _thrust, (0.0,),
        lambda c, x: c["c"] * x[:, 0] * np.abs(x[:, 0]),
    ),
}  # fmt: skip


def wishes(size: str) -> Iterator[Wish]:
    """Each plant, clean and with what is hidden, two of each."""
    for name in KINDS if size != SMALL else ():
        for hide in (False, True):
            for k in range(2):
                words = ("equations", name, "hidden" if hide else "clean", str(k + 1))
                yield Wish(" ".join(words), partial(_draw, " ".join(words), name, hide))


def declared(kind: Kind) -> PlantFile:
    """The plant file as a user would load it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "plant.toml"
        path.write_text(kind.text())
        return load_plant(path)


def _draw(name: str, which: str, hide: bool, seed: int) -> Case:
    kind, rng = KINDS[which], np.random.default_rng(seed)
    constants = kind.draw(rng)
    if not hide:
        constants["hidden"] = 0.0
    file, t_s = declared(kind), kind.dt_s * np.arange(N, dtype=np.float64)
    records, outputs = [], []
    for _ in range(2):
        u = kind.inputs(rng)

        def step(x: FloatArray, k: int, h: float, u: FloatArray = u) -> FloatArray:
            return kind.step(constants, x, float(u[k]), h)

        y = kind.output(constants, moved(step, np.array(kind.start), N, kind.dt_s))
        records.append(u)
        outputs.append(y)
    seen = outputs[0] + kind.noise * rng.standard_normal(N)
    train = Record(file, t_s, np.column_stack([records[0], seen]))
    test = Record(file, t_s, np.column_stack([records[1], np.full(N, np.nan)]))
    target = outputs[1][:, None]
    truth = Truth(target, np.ones_like(target) / target.std(), effect=kind.hidden if hide else "")
    hidden = kind.hidden if hide else ""
    return Case(name, "equations", which, "steps", hidden, "", train, test, truth, for_all=True)
