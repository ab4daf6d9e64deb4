"""Pressures that are smooth: a supply may have been computed, a chamber's was filtered."""

from __future__ import annotations

import numpy as np

from rtid.diagnose.clean import as_measured
from rtid.effects.record_view import has_noise
from tests.diagnose.records import record

MEAN_OF = 20  # samples


def test_a_chamber_that_was_filtered_keeps_its_noise() -> None:
    """A moving mean over 20 ms had no noise left, and `rtid quick` asked for one."""
    model, chunk, _ = record(seed=3)
    smooth = chunk[MEAN_OF:].copy()
    for name in ("p_a", "p_b"):
        column = 2 + model.column(name)
        mean = np.convolve(chunk[:, column], np.full(MEAN_OF, 1.0 / MEAN_OF), "valid")
        smooth[:, column] = mean[:-1]
    smooth[:, 2 + model.column("p_supply")] = 7e6 + 1e5 * np.sin(smooth[:, 0])
    noise = {s.name: s.noise for s in as_measured(model, smooth).signals}
    declared = {s.name: s.noise for s in model.signals}
    assert not has_noise(smooth[:, 2 + model.column("p_a")])
    assert (noise["p_a"], noise["p_b"]) == (declared["p_a"], declared["p_b"])
    assert noise["p_supply"] == 0.0 < declared["p_supply"]
