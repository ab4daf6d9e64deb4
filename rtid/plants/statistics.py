"""What correlated residuals allow to say: how many samples they are worth, and with what spread.

The residual of a free run remembers: n samples are worth n / tau independent ones,

    tau = 1 + 2 * sum of (1 - k / m) rho_k,   k < m   (Bartlett's window).
"""

from __future__ import annotations

import numpy as np
from scipy.special import fdtrc

from rtid.plain import FloatArray

WINDOW = 5.0  # lags in units of tau over which correlation is summed (Sokal)


def autocovariance(e: FloatArray) -> FloatArray:
    """Autocovariance (n,) of a series about zero, in its unit squared; NaN counts as zero."""
    n = len(e)
    spectrum = np.fft.rfft(np.nan_to_num(e), 2 * n)  # with as many zeros behind: no lag wraps
    return np.asarray(np.fft.irfft(np.abs(spectrum) ** 2, 2 * n)[:n] / n)


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
        normal += j.T @ j
        middle += j.T @ _spread(j, taper)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * scale * scale[:, None], rcond=1e-14, hermitian=True)
    inverse *= scale * scale[:, None]
    return np.asarray(inverse @ middle @ inverse)


def f_test(before: float, after: float, more: int, worth: float, parameters: int) -> float:
    """Chance that so many more parameters take the sum of squares down by accident."""
    dof = max(worth - parameters, 1.0)
    return float(fdtrc(more, dof, max(before / after - 1.0, 0.0) * dof / more))


def _spread(j: FloatArray, taper: FloatArray) -> FloatArray:
    """Sum of columns (n, p) at all lags below m, weighed by the taper (m,) of the lag; (n, p)."""
    size = len(j) + len(taper)
    weights = np.zeros(size)
    weights[: len(taper)], weights[size - len(taper) + 1 :] = taper, taper[:0:-1]
    spectrum = np.fft.rfft(j, size, axis=0) * np.fft.rfft(weights)[:, None]
    return np.asarray(np.fft.irfft(spectrum, size, axis=0)[: len(j)])
