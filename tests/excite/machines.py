"""Random booms with what their owner knows of them, and a designed motion run on the true ones.

The owner knows the controller (it is his), the geometry exactly, the bulk modulus up to 30 %, and
estimates load (10 %), mass (20 %) and friction (30 %).  The data sheet describes the type of the
valves: the mean of the four, with up to 10 % of gain and 0.3 V of dead band wrong.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rtid.excite.driving import OFFSET, SHUT, SUPPLY, V_REF, X_REF
from rtid.exciting import read_csv
from rtid.model import FloatArray
from rtid.paper.boom import MOST_OF_STROKE, TOP_V, boom, grid
from rtid.sim import loop
from rtid.sim.declare import declared_model
from rtid.sim.motion import Motion
from rtid.sim.plant import Plant, Valve
from rtid.sim.project_file import project_text

COMMAND_V = 9.0
LEAST_SUPPLY = 0.6  # of the usual one
GAIN_ERROR, DEADBAND_ERROR_V = 0.1, 0.3


def machine(number: int) -> Plant:
    """A random boom whose controller cuts the command at the limit."""
    plant = boom(number)
    return replace(plant, controller=plant.controller._replace(limit_v=COMMAND_V))


def write_project(
    folder: Path, plant: Plant, number: int, *, safe_v: float = 1.0, **more: object
) -> Path:
    """The owner's project file with its data sheet beside it; more: lines of [excite].

    safe_v: up to which a valve is declared to be shut; 0: nothing is declared, the map is free.
    """
    rng = np.random.default_rng([number, 91])
    sheet = folder / "sheet.csv"
    sheet.write_text(_sheet(plant, rng), "utf-8")
    blocks = grid()
    if safe_v == 0.0:
        blocks = replace(blocks, u_v=np.concatenate([[0.0, 0.5], blocks.u_v]))
    model = declared_model(plant, grid=blocks, seed=number, safe_band_v=safe_v)
    text = project_text(model, plant.constants.stroke_m, "boom")
    for edge in plant.edges:
        text = text.replace(f"[edges.{edge}]\n", f'[edges.{edge}]\nreference_map = "sheet.csv"\n')
    lines = [f"{key} = {value}" for key, value in (_section(plant, rng) | more).items()]
    path = folder / "boom.toml"
    path.write_text(text + "\n[excite]\n" + "\n".join(lines) + "\n", "utf-8")
    return path


def _sheet(plant: Plant, rng: np.random.Generator) -> str:
    valves = plant.valves[:4]
    gain = float(np.mean([v.gain for v in valves])) * rng.uniform(1 - GAIN_ERROR, 1 + GAIN_ERROR)
    shift_v = rng.uniform(-DEADBAND_ERROR_V, DEADBAND_ERROR_V)
    valve = Valve(gain, float(np.mean([v.deadband_v for v in valves])) + shift_v)
    typical = replace(plant, valves=(valve,) * 5)
    u = np.linspace(0.0, 10.0, 101)
    k = typical.flow("pa", u, np.full_like(u, 1e6)) / 1e3
    return "\n".join(["abs_u_V,K", *(f"{a:.6g},{b:.9g}" for a, b in zip(u, k, strict=True))]) + "\n"


def _section(plant: Plant, rng: np.random.Generator) -> dict[str, object]:
    """Limits: the sweep's stroke, 1.3 times its speed, its command, the range of the sensors."""
    c, k, usual = plant.constants, plant.controller, plant.p_supply_pa * 1e-6
    about = {n: rng.uniform(1 - e, 1 + e) for n, e in (("mass", 0.2), ("load", 0.1), ("rub", 0.3))}
    low, high = (0.5 - MOST_OF_STROKE) * c.stroke_m, (0.5 + MOST_OF_STROKE) * c.stroke_m
    return {
        "stroke_m": [low, high],
        "speed_mps": 1.3 * (TOP_V - k.deadband_v) / k.volts_per_mps,
        "command_v": COMMAND_V,
        "offset_v": 1.0,
        "pressure_mpa": [0.1, 10.0],
        "supply_mpa": [LEAST_SUPPLY * usual, usual],
        "usual_supply_mpa": usual,
        "mass_kg": c.mass_kg * about["mass"],
        "load_n": c.gravity_n * about["load"],
        "load_slope_n_per_m": c.gravity_slope_npm,
        "friction_n": 250.0,
        "friction_ns_per_m": 3500.0 * about["rub"],
        "kp_per_s": k.kp_1ps,
        "volts_per_mps": k.volts_per_mps,
        "deadband_v": k.deadband_v,
        "blend_mps": k.blend_mps,
    }


def motion(reference: FloatArray) -> Motion:
    """A designed reference (n, 5) as the simulated machine takes it."""

    def drive(plant: Plant, rng: np.random.Generator, duration_s: float) -> FloatArray:
        rows = np.vstack([reference, reference[-1:]])
        found = np.zeros((len(rows), 6))
        found[:, loop.X_REF] = np.where(rows[:, SHUT] > 0, np.nan, rows[:, X_REF])
        found[:, loop.V_REF], found[:, loop.DITHER] = rows[:, V_REF], rows[:, OFFSET]
        found[:, loop.P_SUPPLY], found[:, loop.P_TANK] = rows[:, SUPPLY], plant.p_tank_pa
        return found

    return drive


def motion_of(path: Path) -> Motion:
    """The motion of an exported CSV."""
    return motion(read_csv(path))
