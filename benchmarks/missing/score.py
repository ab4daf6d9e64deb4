"""What an answer is worth beside the truth; and what several of them are worth together.

unseen    rms of (prediction - target) scale, averaged over `mean_over` samples, 1
map       rms error at the working points that were visited, of an edge's largest flow there
beta      largest relative error over the chambers
coverage  share of the map's points, and of the moduli, whose 95 % interval holds the truth
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.missing.record import OUTSIDE, UNKNOWN, Case, Learned, Names
from rtid.plain import FloatArray

Z95 = 1.96
LARGEST_SET = 3  # causes that an honest set may have
RIGHT, IN_SET, AMONG, SILENT, UNKNOWN_WORD, WRONG, ALARM, QUIET, FAILED = JUDGEMENTS = (
    "right", "in a set", "among others", "not seen", "unknown", "wrong name", "false alarm",
    "rightly silent", "failed",
)  # fmt: skip


@dataclass(frozen=True)
class Score:
    """Of one answer; NaN and "" where there is none.  Shares are of 1."""

    unseen: float
    map_error: float
    map_cover: float
    beta_error: float
    beta_cover: float
    judgement: str
    named: tuple[tuple[str, ...], ...]


def scored(case: Case, learned: Learned) -> Score:
    """The answer to a case."""
    beta, beta_cover = _beta(case, learned)
    error, cover = _map(case, learned)
    missing = learned.missing
    return Score(
        unseen_error(case, learned.predict(case.test)),
        error, cover, beta, beta_cover,
        "" if missing is None else judged(case.truth.effect, missing),
        () if missing is None else tuple(tuple(sorted(names)) for names in missing),
    )  # fmt: skip


def unseen_error(case: Case, predicted: FloatArray) -> float:
    """Error on the motion that nobody has seen; infinite where a prediction is not finite."""
    truth, m = case.truth, case.truth.mean_over
    error = (predicted - truth.target) * truth.scale
    whole = (len(error) - 1) // m * m  # the last sample has no rate
    means = error[:whole].reshape(-1, m, error.shape[1]).mean(axis=1)
    return float(np.sqrt(np.mean(means**2))) if np.isfinite(means).all() else float("inf")


def _map(case: Case, learned: Learned) -> tuple[float, float]:
    if learned.flow is None or case.truth.flow is None:
        return float("nan"), float("nan")
    errors, inside = [], []
    for edge, (w, dp) in case.truth.points.items():
        true = case.truth.flow(edge, w, dp)
        off = np.nan_to_num(learned.flow(edge, w, dp)) - true  # no number: as if it were shut
        errors.append(off / np.abs(true).max())
        if learned.flow_sd is not None:
            inside.append(np.abs(off) <= Z95 * np.nan_to_num(learned.flow_sd(edge, w, dp)))
    cover = float(np.mean(np.concatenate(inside))) if inside else float("nan")
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))), cover


def _beta(case: Case, learned: Learned) -> tuple[float, float]:
    if learned.beta_pa is None or not np.isfinite(case.truth.beta_pa):
        return float("nan"), float("nan")
    off = learned.beta_pa - case.truth.beta_pa
    cover = float("nan")
    if learned.beta_sd_pa is not None:
        cover = float(np.mean(np.abs(off) <= Z95 * learned.beta_sd_pa))
    return float(np.abs(off).max() / case.truth.beta_pa), cover


def judged(effect: str, missing: Names) -> str:
    """What the names are worth; effect: the truth, "" for none; AMONG: beside false names."""
    if not effect:
        return ALARM if missing else QUIET
    if not missing:
        return SILENT
    if missing == UNKNOWN:
        return UNKNOWN_WORD
    sets = [names for names in missing if effect in names]
    if effect == OUTSIDE or not sets or len(sets[0]) > LARGEST_SET:
        return WRONG
    if len(missing) > 1:
        return AMONG
    return RIGHT if len(sets[0]) == 1 else IN_SET
