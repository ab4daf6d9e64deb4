"""One revision of the model held against a record: plain arrays, from which pictures are made.

A revision with effects is learned beside them, as `rtid compare` does it.  A look is held for every
revision, and by the page as well as on its way there: of every sample it has what pictures show, in
the precision that they have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np

from rtid.compare import (
    HORIZONS_S,
    BlockRow,
    CandidateMap,
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
from rtid.plain import FloatArray, IntArray
from rtid.study.compared import parts_of
from rtid.study.kept_record import Replay


@dataclass(frozen=True)
class SpanLook:
    """A part of the record: equation residual, simulated pressures, dependences, blocks.

    runs and their fits (chambers,) in per cent: by the names of `HORIZONS_S`, empty where the
    machine has no pressures to simulate.
    """

    equation: Comparison
    runs: dict[str, Simulation]
    fits: dict[str, FloatArray]
    depends: list[Dependence]
    blocks: list[BlockRow]


class RecordShare(NamedTuple):
    """What is left of one of several records, in per cent of its own flow."""

    name: str
    is_held_out: bool
    percent: float


@dataclass(frozen=True, eq=False)  # what is learned anew is another one
class Look:
    """A revision held against every part of the record, and its published map.

    records: what is left of each of several.
    """

    model: Machine
    parts: dict[str, SpanLook]
    flowmap: FlowMap
    beta_pa: FloatArray
    beta_sd_pa: FloatArray
    lag_s: float
    records: tuple[RecordShare, ...] = ()


def look(result: Replay) -> Look:
    """Hold what was learned from a record against it."""
    flowmap = result.map
    solution, candidate = result.fit.solution, learned(result.fit, flowmap)
    signals = [signal.name for signal in result.project.model.signals] + ["velocity"]
    parts = {}
    for title, chunk in parts_of(result).items():
        equation = compare(result.model, candidate, chunk)
        depends = [d for d in against_signals(result.model, equation) if d.signal in signals]
        depends += [*across_piston(result.model, equation), over_time(equation)]
        blocks, equation = block_rows(solution, equation, flowmap), _drawn(equation)
        runs, fits = _runs(result.model, candidate, chunk, equation.intervals.t_s)
        parts[title] = SpanLook(equation, runs, fits, depends, blocks)
    beta, sd = solution.beta_pa, solution.beta_sd_pa
    return Look(result.model, parts, flowmap, beta, sd, result.fit.lag_s)


def _drawn(equation: Comparison) -> Comparison:
    """Of the samples, only when each edge was in which block."""
    nothing, inner = np.empty((0, len(equation.rho))), equation.intervals
    cell = cast("IntArray", inner.cell.astype(np.int32))
    inner = replace(inner, cell=cell, innovation=nothing, own=nothing, values=nothing)
    return replace(equation, intervals=inner)


def _runs(
    model: Machine, candidate: CandidateMap, chunk: FloatArray, t_s: FloatArray
) -> tuple[dict[str, Simulation], dict[str, FloatArray]]:
    """Simulated pressures of samples chunk (n, 2 + signals), SI, at t_s (n,), and their fits."""
    runs: dict[str, Simulation] = {}
    fits: dict[str, FloatArray] = {}
    if why_no_free_run(model) or len(chunk) < 2:
        return runs, fits
    x, measured = smooth_position(model, chunk), np.empty(0)
    for name in HORIZONS_S:
        run = simulate(model, candidate, chunk, name, position_m=x)
        fits[name] = run.fit_percent
        measured = measured if len(measured) else _single(run.measured_pa)
        status = cast("IntArray", run.status.astype(np.int8))
        simulated = _single(run.simulated_pa)
        runs[name] = replace(
            run, t_s=t_s, measured_pa=measured, simulated_pa=simulated, status=status
        )
    return runs, fits


def _single(values: FloatArray) -> FloatArray:
    """In single precision: 2 Pa of 20 MPa."""
    return cast("FloatArray", values.astype(np.float32))
