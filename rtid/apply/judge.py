"""Whether a new map foretells the machine better than the one that the controller holds.

Both are held against the same samples, which neither has learned from, through the same filter and
with the same lag; each brings its own bulk modulus.  Of every block of BLOCK_S with motion the mean
squared residuals, in units of what the held map leaves, are compared in pairs:

    d_k = (r_held^2 - r_new^2)_k / mean(r_held^2),     t = mean(d) / (sd(d) / sqrt(n))

Pairs cancel what both suffer from alike, noise and unmodelled effects, and blocks of a second are
longer than the filter remembers.  Better is: t > T_LIMIT, and the rms residual falls by the share
that the project asks for.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rtid.compare import CandidateMap, LearnedReference, compare
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.state import nominal_weights
from rtid.model import Machine
from rtid.plain import FloatArray

BLOCK_S = 1.0
LEAST_BLOCKS = 10
T_LIMIT = 3.0
MOTION = 0.05  # share of the largest rated flow by which a block counts as motion


@dataclass(frozen=True, eq=False)
class KnownMap:
    """A map with its bulk modulus per chamber (chambers,), inf where it is not known."""

    flow_map: FlowMap
    beta_pa: FloatArray


@dataclass(frozen=True)
class Judgement:
    """Root mean squares of the equation residual, m3/s, over `blocks` seconds with motion.

    held_m3s: of the map held; where nothing was held, of the motion itself.
    """

    seconds: float
    blocks: int
    held_m3s: float
    new_m3s: float
    t: float
    against: str  # "held map" or "no map"
    is_better: bool
    reason: str

    @property
    def gain_percent(self) -> float:
        """By how much the residual falls."""
        return 100.0 * (1.0 - self.new_m3s / self.held_m3s) if self.held_m3s > 0 else 0.0

    def as_json(self) -> dict[str, Any]:
        """All fields."""
        return asdict(self) | {"gain_percent": self.gain_percent}


def judge(
    model: Machine,
    chunk: FloatArray,
    old: KnownMap | None,
    new: KnownMap,
    gain_percent: float,
    terms: FloatArray | None = None,
) -> Judgement:
    """Compare on samples chunk (n, 2 + signals), rows as in `to_chunk`, that neither has seen.

    terms: coefficients of the model's shared terms, for both.  old = None: no map at all.
    """
    after, motion, block = _squares(model, chunk, new, terms)
    before = motion if old is None else _squares(model, chunk, old, terms)[0]
    against = "no map" if old is None else "held map"
    limit = (MOTION * max((e.rated_q_m3s for e in model.edges), default=0.0)) ** 2
    moving = [
        k for k in np.unique(block) if motion[block == k].mean() > limit and (block == k).sum() > 10
    ]
    pairs = np.array([[before[block == k].mean(), after[block == k].mean()] for k in moving])
    seconds = float(chunk[-1, 0] - chunk[0, 0]) if len(chunk) else 0.0
    if len(pairs) < LEAST_BLOCKS:
        reason = f"{len(pairs)} s of motion, {LEAST_BLOCKS} needed"
        return Judgement(seconds, len(pairs), 0.0, 0.0, 0.0, against, False, reason)
    mean = pairs.mean(axis=0)
    d = (pairs[:, 0] - pairs[:, 1]) / mean[0]
    t = float(d.mean() / max(d.std(ddof=1) / np.sqrt(len(d)), 1e-12))
    held_rms, new_rms = (float(x) for x in np.sqrt(mean))
    gain = 100.0 * (1.0 - new_rms / held_rms)
    is_better = t > T_LIMIT and gain >= gain_percent
    reason = f"residual {'falls' if gain > 0 else 'rises'} by {abs(gain):.1f} %, t = {t:.1f}" + (
        "" if is_better else f"; wanted: {gain_percent:g} % and t > {T_LIMIT:g}"
    )
    return Judgement(seconds, len(pairs), held_rms, new_rms, t, against, is_better, reason)


def _squares(
    model: Machine, chunk: FloatArray, known: KnownMap, terms: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Squared residual, squared motion and block of each row of H_f, summed over the chambers."""
    part = compare(model, candidate(model, known, terms), chunk)
    residual, motion = part.residual_m3s, part.measured_m3s
    good = np.isfinite(residual).all(axis=1)
    block = np.floor((part.t_s[good] - part.t_s[:1]) / BLOCK_S) if len(part.t_s) else part.t_s
    return (residual[good] ** 2).sum(axis=1), (motion[good] ** 2).sum(axis=1), block


def candidate(model: Machine, known: KnownMap, terms: FloatArray | None = None) -> CandidateMap:
    """With nominal weights: innovations are not asked for.  Another grid is projected on this.

    terms (terms,): coefficients of the shared terms in SI, zero where not given.
    """
    flow_map = known.flow_map
    if _same_grids(model, flow_map):
        theta = flow_map.theta_cells()
        status = np.concatenate([edge.status.ravel() for edge in flow_map.edges])
    else:
        theta = LearnedReference("held", flow_map).theta_cells(model)
        status = np.full(len(theta), "reference")
    none = np.zeros(len(model.terms))
    extra = none if terms is None else terms
    return CandidateMap("", theta, 1.0 / known.beta_pa, status, nominal_weights(model), extra)


def _same_grids(model: Machine, flow_map: FlowMap) -> bool:
    pairs = zip(model.maps, flow_map.edges, strict=False)
    return len(model.maps) == len(flow_map.edges) and all(
        mine.name == other.name
        and np.array_equal(mine.grid.u_v, other.grid.u_v)
        and np.array_equal(mine.grid.dp_pa, other.grid.dp_pa)
        for mine, other in pairs
    )
