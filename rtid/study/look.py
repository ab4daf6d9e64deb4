"""One revision of the model held against a record: plain arrays, from which pictures are made.

A revision with effects is learned beside them, as `rtid compare` does it.
"""

from __future__ import annotations

from dataclasses import dataclass

from rtid.compare import (
    HORIZONS_S,
    BlockRow,
    Comparison,
    Dependence,
    Simulation,
    across_piston,
    against_signals,
    block_rows,
    compare,
    learned,
    over_time,
    simulate,
    smooth_position,
)
from rtid.compare.simulation import why_no_free_run
from rtid.estimator.flowmap import FlowMap
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.study.compared import parts_of
from rtid.study.kept_record import Replay


@dataclass(frozen=True)
class SpanLook:
    """A part of the record: equation residual, simulated pressures, dependences, blocks.

    runs: by the names of `HORIZONS_S`, empty where the machine has no pressures to simulate.
    """

    equation: Comparison
    runs: dict[str, Simulation]
    depends: list[Dependence]
    blocks: list[BlockRow]


@dataclass(frozen=True)
class Look:
    """A revision held against every part of the record, and its published map."""

    model: Machine
    parts: dict[str, SpanLook]
    flowmap: FlowMap
    beta_pa: FloatArray
    beta_sd_pa: FloatArray
    lag_s: float


def look(result: Replay) -> Look:
    """Hold what was learned from a record against it."""
    flowmap = result.map
    solution, candidate = result.fit.solution, learned(result.fit, flowmap)
    signals = [signal.name for signal in result.project.model.signals] + ["velocity"]
    parts = {}
    for title, chunk in parts_of(result).items():
        equation = compare(result.model, candidate, chunk)
        runs = {}
        if not why_no_free_run(result.model) and len(chunk) > 1:
            x = smooth_position(result.model, chunk)
            runs = {
                name: simulate(result.model, candidate, chunk, name, position_m=x)
                for name in HORIZONS_S
            }
        depends = [d for d in against_signals(result.model, equation) if d.signal in signals]
        depends += [*across_piston(result.model, equation), over_time(equation)]
        parts[title] = SpanLook(equation, runs, depends, block_rows(solution, equation, flowmap))
    beta, sd = solution.beta_pa, solution.beta_sd_pa
    return Look(result.model, parts, flowmap, beta, sd, result.fit.lag_s)
