"""Errors in variables: the pressure noise in -V dP taken out of the compliances' information.

Least squares would draw theta_beta towards zero by the share that noise has in the column's square;
the rows' noise is known, so is its sum, and the corrected estimate is unbiased where the motion
holds more than the noise pretends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.estimator.factor import SHARED_PRIOR, Factor, misfit
from rtid.estimator.sums import Sums
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import FloatArray


@dataclass(frozen=True)
class Corrected:
    """The estimate with the noise in -V dP taken out: errors in variables, least squares corrected.

    theta (n,); basis (n, chambers): how theta follows the compliances; cov_change (chambers,
    chambers): what the correction adds to their covariance; cost: the minimum of
    |y - rows theta|^2 - theta' noise theta, comparable between nuisance parameters.
    """

    theta: FloatArray
    basis: FloatArray
    cov_change: FloatArray
    cost: float


def plain(sums: Sums, factor: Factor) -> tuple[FloatArray, FloatArray]:
    """The estimate (n,) without correction, and its covariance with the compliances (n, chambers).

    Both in the scaled units of the sums.
    """
    right = sums.right
    units = np.eye(len(right), len(sums.noise))
    solved = factor.theta(np.column_stack([right, units]))
    return solved[:, 0], solved[:, 1:]


def correct(sums: Sums, theta: FloatArray, columns: FloatArray, leverage: FloatArray) -> Corrected:
    """Take the noise out of the compliances' information, and let the flow terms follow.

    theta (n,) and columns (n, chambers): as from `plain`; leverage (chambers,): share of the noise
    that the flow terms absorb (see `leverage_of`).  Where the motion holds no more information
    than the noise pretends, little is left, and the variance says so.
    """
    n_c = len(sums.noise)
    information = np.linalg.inv(columns[:n_c])
    noise = np.diag(sums.noise * (1 - leverage))
    least = SHARED_PRIOR + 3 * np.sqrt(2 / max(1, sums.rows)) * sums.noise
    rest, drawn = _at_least(information - noise, least)
    cov = np.linalg.inv(rest)
    basis = columns @ information
    shift = cov @ information @ theta[:n_c] - theta[:n_c]
    # noise times noise: its share of the rows' own variance adds to that of the product
    noise_share = sums.noise / max(1, sums.rows)
    cov_change = cov + cov @ (noise * (1 + noise_share)) @ cov - columns[:n_c] + drawn
    shared = theta[:n_c] + shift
    cost = misfit(sums, theta) + shift @ information @ shift - shared @ noise @ shared
    return Corrected(theta + basis @ shift, basis, cov_change, float(cost))


def _at_least(information: FloatArray, least: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Symmetric matrix with its eigenvalues, in units of `least`, raised to 1; and the error.

    At 1, three standard deviations of what noise alone pretends, nothing may be known at all, and
    the estimate is drawn to zero; from 2 on the variance tells.  The second result is the square
    of the error so made, for compliances of the nominal size.
    """
    scale = np.sqrt(least)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    missing = np.clip(2.0 - values, 0.0, 1.0)
    raised = (vectors * np.maximum(values, 1.0)) @ vectors.T
    drawn = (vectors / scale[:, None]) * missing * (vectors.T @ scale)
    return np.asarray(raised * np.outer(scale, scale)), np.asarray(drawn @ drawn.T)


def leverage_of(model: Machine, sums: Sums, effective: FloatArray) -> FloatArray:
    """Share (chambers,) of the noise in each column -V dP that the flow terms absorb.

    Noise that the maps can follow never reaches theta_beta.  effective (n,): degrees of freedom
    per unknown.  Terms of the chamber's own edges lie in the same direction of the pair of
    whitened rows as the noise; those of the other chamber at the angle whose cosine is the
    correlation of the two innovations.
    """
    n_c = len(model.chambers)
    signs = np.array([[edge.sign(chamber) for chamber in model.chambers] for edge in model.edges])
    feeds = signs[sums.blocks["edge"]] != 0
    terms = effective[sums.n_shared :].reshape(-1, TERMS).sum(axis=1)
    s00, s01, s11 = sums.innovation
    alike = s01**2 / (s00 * s11) if n_c == 2 and s00 * s11 > 0 else 0.0
    cosines = np.where(np.eye(n_c, dtype=bool), 1.0, alike)
    return np.clip(cosines @ (terms @ feeds) / max(1.0, sums.rows), 0.0, 0.9)
