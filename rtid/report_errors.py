"""Figures of a report that its page and its stills share."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from rtid.diagnosed_text import title
from rtid.report_story import Told

PARTS = "identification part", "held-out part"
RANKED = 16  # candidates that are shown
BEFORE, AFTER = "model as it is", "with what was found"
T = TypeVar("T")


def models(before: T, after: T | None) -> dict[str, T]:
    """What there is of both, by name."""
    return {BEFORE: before} | ({AFTER: after} if after is not None else {})


def share(told: Told, residual_m3s: float) -> float:
    """In per cent of the rms flow."""
    return 100.0 * residual_m3s / told.diagnosed.diagnosis.rms_flow_m3s


def steps(told: Told) -> list[tuple[str, float]]:
    """Error behind each addition, in per cent of the rms flow."""
    found = told.diagnosed.diagnosis
    start = BEFORE if not found.added else "model with what was added before"
    made = [(start, share(told, found.heldout_residual_before_m3s))]
    made += [
        (f"+ {title(e.effect)} ({e.where})", share(told, e.heldout_residual_after_m3s))
        for e in found.found
    ]
    last = share(told, found.heldout_residual_after_m3s)
    if found.found and found.negligible and not np.isclose(last, made[-1][1], rtol=0.01):
        made.append(("+ what is present but negligible", last))
    return made


def floor(told: Told) -> float:
    """What the sensors alone leave, in per cent of the rms flow."""
    return share(told, told.diagnosed.diagnosis.noise_floor_m3s)


def can_be_judged(told: Told) -> bool:
    """True where all errors are known."""
    return all(np.isfinite([floor(told), *(value for _, value in steps(told))]))
