"""Random booms with what their owner knows of them, and a designed motion run on the true ones.

The owner knows the controller (it is his), the geometry exactly, the bulk modulus up to 30 %, and
estimates load (10 %), mass (20 %) and friction (30 %).  The data sheet has a column for every
valve, each with up to 10 % of gain and 0.3 V of dead band wrong, as in Fig. 6.  The limits are what
the paper's sweep itself takes on the true machine: its stroke, its largest speed, command and
pressure.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from rtid.excite.driving import OFFSET, SHUT, SUPPLY, V_REF, X_REF
from rtid.excite.exciting import read_csv
from rtid.plain import FloatArray
from rtid.sim import closed_loop
from rtid.sim.boom import SWEEP_S, boom, grid, sweep
from rtid.sim.declare import declared_model
from rtid.sim.demand import Motion
from rtid.sim.programmable import manufacturer
from rtid.sim.project_file import project_text
from rtid.sim.run import EXACT, P_A, P_B, U, V, X, simulate
from rtid.sim.simulated_plant import SimulatedPlant

GRID_END_V = 9.0
LEAST_SUPPLY = 0.6  # of the usual one
STEPS_V = 0.6  # dither that is allowed on top of the controller's command
LEAST_PA = 1e5  # of a chamber, against cavitation


@cache
def swept(number: int) -> FloatArray:
    """Noise-free signals of the paper's sweep on the true machine."""
    return simulate(_cut(boom(number), GRID_END_V), sweep, number, SWEEP_S, EXACT).truth.signals


def machine(number: int) -> SimulatedPlant:
    """A random boom whose controller cuts the command at the sweep's largest."""
    return _cut(boom(number), float(np.abs(swept(number)[:, U]).max()))


def _cut(plant: SimulatedPlant, limit_v: float) -> SimulatedPlant:
    return replace(plant, controller=plant.controller._replace(limit_v=limit_v))


def write_project(
    folder: Path, plant: SimulatedPlant, number: int, *, safe_v: float = 1.0, **more: object
) -> Path:
    """The owner's project file with its data sheet beside it; more: lines of [excite].

    safe_v: up to which a valve is declared to be shut; 0: nothing is declared, the map is free.
    """
    blocks = grid()
    if safe_v == 0.0:
        blocks = replace(blocks, u_v=np.concatenate([[0.0, 0.5], blocks.u_v]))
    model = declared_model(plant, grid=blocks, seed=number, safe_band_v=safe_v)
    text = project_text(model, plant.constants.stroke_m, "boom")
    (folder / "sheet.csv").write_text(_sheet(plant, number), "utf-8")
    for edge in plant.edges:
        text = text.replace(f"[edges.{edge}]\n", f'[edges.{edge}]\nreference_map = "sheet.csv"\n')
    lines = [f"{key} = {value}" for key, value in (_section(plant, number) | more).items()]
    path = folder / "boom.toml"
    path.write_text(text + "\n[excite]\n" + "\n".join(lines) + "\n", "utf-8")
    return path


def _sheet(plant: SimulatedPlant, number: int) -> str:
    """K of every valve over the command: the manufacturer's of Fig. 6."""
    flow, u, dp_pa = manufacturer(plant, number), np.linspace(0.0, 10.0, 101), 1e6
    k = [flow(edge, u, np.full_like(u, dp_pa)) / np.sqrt(dp_pa) for edge in plant.edges]
    head = ",".join(["abs_u_V", *(f"K_{edge}" for edge in plant.edges)])
    rows = (",".join(f"{value:.9g}" for value in row) for row in np.column_stack([u, *k]))
    return "\n".join([head, *rows]) + "\n"


def _section(plant: SimulatedPlant, number: int) -> dict[str, object]:
    """Limits: what the sweep takes; steps and supply as allowed here."""
    c, k, usual = plant.constants, plant.controller, plant.p_supply_pa * 1e-6
    taken, rng = swept(number), np.random.default_rng([number, 91])
    about = {n: rng.uniform(1 - e, 1 + e) for n, e in (("mass", 0.2), ("load", 0.1), ("rub", 0.3))}
    x, most_pa = taken[:, X], float(taken[:, [P_A, P_B]].max())
    return {
        "stroke_m": [float(x.min()), float(x.max())],
        "speed_mps": float(np.abs(taken[:, V]).max()),
        "command_v": k.limit_v,
        "offset_v": STEPS_V,
        "pressure_mpa": [LEAST_PA * 1e-6, most_pa * 1e-6],
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

    def drive(plant: SimulatedPlant, rng: np.random.Generator, duration_s: float) -> FloatArray:
        rows = np.vstack([reference, reference[-1:]])
        found = np.zeros((len(rows), 6))
        found[:, closed_loop.X_REF] = np.where(rows[:, SHUT] > 0, np.nan, rows[:, X_REF])
        found[:, closed_loop.V_REF], found[:, closed_loop.DITHER] = rows[:, V_REF], rows[:, OFFSET]
        found[:, closed_loop.P_SUPPLY], found[:, closed_loop.P_TANK] = (
            rows[:, SUPPLY],
            plant.p_tank_pa,
        )
        return found

    return drive


def motion_of(path: Path) -> Motion:
    """The motion of an exported CSV."""
    return motion(read_csv(path))
