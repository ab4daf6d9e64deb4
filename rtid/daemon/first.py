"""The checks that a first map must stand before it is published: sign, energy and bounds.

The sign is held against the samples alone: also where a map knows nothing of them.
"""

from __future__ import annotations

import numpy as np

from firmware_bridge.samples import Samples
from rtid.estimator.blocks import VALID
from rtid.estimator.solution import Solution
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.trace.check import MIN_CORRELATION, against_motion, against_signs
from rtid.trace.plausible import Motion, motion
from rtid.units import limit

SURE = 5.0  # standard deviations
BACKWARD = 0.05  # share of the valid blocks that may lie across zero
KNOWN = 0.1  # relative deviation up to which a bulk modulus can be held against its bounds


def against_first(model: Machine, chunk: FloatArray, solution: Solution) -> tuple[str, ...]:
    """What speaks against a first map and its samples, in sentences; chunk (n, 2 + signals), SI."""
    findings = against_motion(model, _motion(model, chunk))
    words = [f"{f.subject}: {f.text}" for f in findings if f.level == "error"]
    return (*words, *_against_energy(solution), *_against_bounds(solution))


def wrong_signs(model: Machine, chunk: FloatArray) -> tuple[str, ...]:
    """Signs that samples (n, 2 + signals), SI, without a gap speak against, whatever the map."""
    findings = against_signs(model, _motion(model, chunk))
    return tuple(f"{f.subject}: {f.text}" for f in findings if f.level == "error")


def follows_command(model: Machine, chunk: FloatArray) -> bool:
    """Whether samples (n, 2 + signals), SI, without a gap show that the machine obeys."""
    return _motion(model, chunk).u_to_v > MIN_CORRELATION


def _motion(model: Machine, chunk: FloatArray) -> Motion:
    t_us = np.rint(1e6 * chunk[:, 0]).astype(np.int64)
    names = tuple(signal.name for signal in model.signals)
    flags = chunk[:, 1].astype(np.uint8)
    return motion(model, Samples(names=names, t_us=t_us, values=chunk[:, 2:], flags=flags))


def _against_energy(solution: Solution) -> list[str]:
    """A valve takes energy from the oil: it lets nothing flow towards the higher pressure."""
    wrong, total = 0, 0
    for block in solution.blocks:
        grid = solution.model.edges[block.edge].grid
        low, high = grid.dp_pa[block.j], grid.dp_pa[block.j + 1]
        if block.status == VALID and (low >= 0.0 or high <= 0.0):
            total += 1
            backward = -np.sign(low + high) * block.mean_flow_m3s
            wrong += bool(backward > SURE * block.mean_sd_m3s)
    if wrong <= max(1.0, BACKWARD * total):
        return []
    return [f"{wrong} of {total} blocks let oil flow towards the higher pressure"]


def _against_bounds(solution: Solution) -> list[str]:
    low, high = solution.model.beta_bounds_pa
    pairs = zip(solution.model.chambers, solution.beta_pa, solution.beta_sd_pa, strict=True)
    return [
        f"chambers.{chamber.name}: a bulk modulus of {limit(float(beta), 'Pa')} lies outside its "
        "bounds"
        for chamber, beta, sd in pairs
        if chamber.pressure
        and np.isfinite(beta)
        and sd < KNOWN * abs(beta)
        and not low - SURE * sd < beta < high + SURE * sd
    ]
