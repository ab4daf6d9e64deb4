"""What correlated residuals allow to say: how many samples they are worth, and with what spread.

The residual of a free run remembers: n samples are worth n / tau independent ones,

    tau = 1 + 2 * sum of (1 - k / m) rho_k,   k < m   (Bartlett's window).
"""

from __future__ import annotations

import numpy as np
from scipy.signal import fftconvolve
from scipy.stats import f as fisher

from rtid.plain import FloatArray

WINDOW = 5.0  # lags in units of tau over which correlation is summed (Sokal)


def autocovariance(e: FloatArray) -> FloatArray:
    """Autocovariance (n,) of a series about zero, in its unit squared; NaN counts as zero."""
    e = np.nan_to_num(e)
    return np.asarray(fftconvolve(e, e[::-1])[len(e) - 1 :] / len(e))


def memory(e: FloatArray) -> tuple[float, int]:
    """The factor tau by which a series (n,) has fewer independent samples, and the window m."""
    correlation = autocovariance(e)
    if correlation[0] <= 0:
        return 1.0, 1
    rho = correlation / correlation[0]
    tau = 1.0
    for m in range(2, len(rho) // 4):
        weights = 1.0 - np.arange(1, m) / m
        tau = max(1.0, 1.0 + 2.0 * float(weights @ rho[1:m]))
        if m > WINDOW * tau:
            return tau, m
    return tau, max(2, len(rho) // 4)


def covariance(jacobian: FloatArray, residual: FloatArray) -> FloatArray:
    """Covariance of least-squares estimates under correlated errors.

        (J'J)^-1  J' Omega J  (J'J)^-1,   Omega: tapered autocovariance of the residual.

    jacobian (n, outputs, p), residual (n, outputs; NaN where not used), both scaled.
    """
    n_outputs, p = jacobian.shape[1:]
    normal, middle = np.zeros((p, p)), np.zeros((p, p))
    for o in range(n_outputs):
        used = np.isfinite(residual[:, o])
        j = np.where(used[:, None], jacobian[:, o], 0.0)
        e = residual[:, o]
        _, m = memory(e)
        taper = autocovariance(e)[:m] * (1.0 - np.arange(m) / m) * len(e) / max(used.sum() - p, 1)
        kernel = np.concatenate([taper[:0:-1], taper])
        normal += j.T @ j
        middle += j.T @ fftconvolve(j, kernel[:, None], mode="same", axes=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * scale * scale[:, None], rcond=1e-14, hermitian=True)
    inverse *= scale * scale[:, None]
    return np.asarray(inverse @ middle @ inverse)


def f_test(before: float, after: float, more: int, worth: float, parameters: int) -> float:
    """Chance that so many more parameters take the sum of squares down by accident."""
    dof = max(worth - parameters, 1.0)
    return float(fisher.sf(max(before / after - 1.0, 0.0) * dof / more, more, dof))
