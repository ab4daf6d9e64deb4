"""Model error in a few blocks: one coarse block holds the corner where the dead band ends.

Six terms cannot follow K(u) around a sharp corner.  The error is large, the same at each visit, and
confined to the blocks of that column; it must not steer theta_beta.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from rtid.estimator.chunk import to_chunk
from rtid.model import Grid
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model, default_grid
from rtid.sim.random_plants import draw
from rtid.sim.run import SimulationError, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.known_effects import learned

FIRST_SEED, RECORD_S, CORNER_V = 200, 15.0, 0.01
IDENTIFIABLE = 0.05  # relative standard deviation of beta


@dataclass(frozen=True)
class Corner:
    """Per machine and chamber: relative error of beta, and error in its standard deviations (n,).

    lag_error_s (machines,): of the lag that the record path finds as a nuisance.
    """

    error: FloatArray
    z: FloatArray
    lag_error_s: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Stated relative standard deviation."""
        return np.abs(self.error / self.z)

    @property
    def covered(self) -> float:
        """Share of the truths within two standard deviations."""
        return float((np.abs(self.z) <= 2).mean())

    @property
    def identified(self) -> FloatArray:
        """Errors where the stated standard deviation is at most 5 %."""
        return self.error[self.sd <= IDENTIFIABLE]

    def __str__(self) -> str:
        error, z = 100 * np.abs(self.error), np.abs(self.z)
        return (
            f"|error| median {np.median(error):.2f} %, worst {error.max():.1f} %; "
            f"{100 * self.covered:.0f} % within 2 sd, worst {z.max():.1f} sd; "
            f"lag off by {1e3 * np.abs(self.lag_error_s).max():.2f} ms at most"
        )


def sharp(seed: int) -> SimulatedPlant:
    """A random machine whose valves open abruptly."""
    plant = draw(seed)
    return replace(plant, valves=tuple(replace(v, corner_v=CORNER_V) for v in plant.valves))


def coarse_grid(p_supply_pa: float) -> Grid:
    """The default grid with a single block along u from the safe band to 4 V, dead band inside."""
    default = default_grid(1.25 * p_supply_pa)
    return Grid(np.concatenate([[1.0], default.u_v[default.u_v >= 4.0]]), default.dp_pa)


def fits(seeds: Iterable[int], motion: str) -> Corner:
    """Fit one record of each machine that can be simulated."""
    error, z, lag = [], [], []
    for seed in seeds:
        plant = sharp(seed)
        try:
            run = simulate(plant, motion, seed, RECORD_S)
        except SimulationError:
            continue
        model = declared_model(plant, grid=coarse_grid(plant.p_supply_pa), seed=seed)
        fit = learned(model, to_chunk(model, run.samples, 0))
        miss = fit.solution.beta_pa - plant.beta_pa
        error.append(miss / plant.beta_pa)
        z.append(miss / fit.solution.beta_sd_pa)
        lag.append(fit.lag_s - plant.lag_s)
    return Corner(np.concatenate(error), np.concatenate(z), np.array(lag))
