"""What the whitened innovations are still correlated with: themselves, and each input.

    r_ee(k) = corr(e_t, e_t-k)            r_eu(k) = corr(e_t, u_t-k)

A model that explains everything leaves white e.  The 95 % bands are Bartlett's (1935): for two
series that have nothing to do with each other

    var r_eu(k) = 1 / N_k  sum over j of rho_ee(j) rho_uu(j),

so an input's own correlation counts as far as e is correlated too; N_k pairs of rows.

Positive lags: the input comes first, the model misses some of its effect.  Negative lags: e comes
first, that is feedback, a controller that sees the sensors' noise, and no fault of the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.fft import irfft, rfft

from rtid.compare.comparison import Comparison
from rtid.model import COMMAND, PRESSURE, Machine
from rtid.plain import FloatArray
from rtid.units import Z95

MAX_LAG_S = 0.2
MOST_LAGS = 400
MEMORY = 4  # of the bands' sum over j, in largest lags
VARIES = 3.0  # an input's standard deviation in those of its noise, below which it is constant


@dataclass(frozen=True)
class Correlation:
    """Of one chamber's innovations with a signal (itself: `itself`), lags_s and value (l,).

    band (l,): half width, 95 % of the lags of an unrelated signal lie within.
    """

    chamber: str
    signal: str
    lags_s: FloatArray
    value: FloatArray
    band: FloatArray

    @property
    def itself(self) -> bool:
        """Whether it is the autocorrelation; its lags are all positive."""
        return self.signal == ""

    @property
    def outside(self) -> float:
        """Share of the lags of 0 and later outside the band; 0.05 is what chance gives."""
        return self._outside(self.lags_s >= 0)

    @property
    def feedback(self) -> float:
        """Share of the negative lags outside the band."""
        return self._outside(self.lags_s < 0)

    def _outside(self, at: np.ndarray) -> float:
        return float(np.mean(np.abs(self.value[at]) > self.band[at])) if at.any() else 0.0


def correlations(
    model: Machine, part: Comparison, max_lag_s: float = MAX_LAG_S
) -> list[Correlation]:
    """Autocorrelation of every chamber's innovations and their correlation with every input.

    Inputs are the commands and the pressures that are no chamber's, as far as they vary.
    """
    e = part.intervals.own
    at = np.flatnonzero(np.isfinite(e).all(axis=1))
    if len(at) < 16:
        return []
    t_s = part.intervals.t_s[1:][at]
    step_s = float(np.median(np.diff(t_s)))
    lags = int(min(MOST_LAGS, len(at) // 4, max(1, round(max_lag_s / step_s))))
    row = np.round((t_s - t_s[0]) / step_s).astype(int)
    n, correlated = int(row[-1]) + 1, []
    known = np.zeros(n)
    known[row] = 1.0
    for c, chamber in enumerate(model.chambers):
        error = _centred(row, e[at, c], n)
        errors = _Series(error, known, (MEMORY + 1) * lags)
        correlated.append(_auto(chamber.name, errors, lags, step_s))
        for name, values in _inputs(model, part, at):
            other = _Series(_centred(row, values, n), known, (MEMORY + 1) * lags)
            correlated.append(_cross(chamber.name, name, errors, other, lags, step_s))
    return correlated


def _inputs(model: Machine, part: Comparison, at: np.ndarray) -> list[tuple[str, FloatArray]]:
    """Inputs over the intervals that end in the rows `at`."""
    states = {chamber.pressure for chamber in model.chambers}
    inputs = []
    for k, signal in enumerate(model.signals):
        if signal.kind in (COMMAND, PRESSURE) and signal.name not in states:
            values = part.intervals.values[at, k]
            noise = np.hypot(signal.noise, signal.resolution)
            if values.std() > max(VARIES * noise, 1e-9 * np.abs(values).max()):
                inputs.append((signal.name, values))
    return inputs


def _centred(row: np.ndarray, values: FloatArray, n: int) -> FloatArray:
    series = np.zeros(n)
    series[row] = values - values.mean()
    return series


class _Series:
    """A centred series with gaps (zeros), its spectrum and its autocorrelation up to `most`."""

    def __init__(self, values: FloatArray, known: FloatArray, most: int) -> None:
        from scipy.fft import next_fast_len  # noqa: PLC0415 - takes long to import

        self.n = len(values)
        self.size = next_fast_len(self.n + most + 1, real=True)
        self.spectrum, self.mask = rfft(values, self.size), rfft(known, self.size)
        self.power = float(values @ values)
        pairs = np.maximum(np.round(irfft(np.abs(self.mask) ** 2, self.size)), 1.0)
        raw = irfft(np.abs(self.spectrum) ** 2, self.size)
        scale = known.sum() / max(self.power, 1e-300)
        self.pairs = pairs
        self.rho = (raw / pairs * scale)[: min(most, self.n - 1) + 1]


def _auto(chamber: str, series: _Series, lags: int, step_s: float) -> Correlation:
    k = np.arange(1, lags + 1)
    lags_s = np.asarray(k * step_s)
    band = Z95 / np.sqrt(series.pairs[k])
    return Correlation(chamber, "", lags_s, series.rho[k], band)


def _cross(
    chamber: str, name: str, first: _Series, other: _Series, lags: int, step_s: float
) -> Correlation:
    k = np.arange(-lags, lags + 1)
    lags_s = np.asarray(k * step_s)
    # sum over t of e_t u_t-k: the inverse transform of E conj(U), at lag k
    raw = irfft(first.spectrum * np.conj(other.spectrum), first.size)[k]
    value = raw / np.sqrt(max(first.power * other.power, 1e-300))
    most = min(len(first.rho), len(other.rho))
    taper = 1.0 - np.arange(1, most) / most
    related = 1.0 + 2.0 * float((taper * first.rho[1:most] * other.rho[1:most]).sum())
    band = Z95 * np.sqrt(max(related, 1.0 / first.n) / first.pairs[np.abs(k)])
    return Correlation(chamber, name, lags_s, value, band)
