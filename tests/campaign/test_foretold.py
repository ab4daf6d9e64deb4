"""Tracking as foretold before the download, beside what 30 machines then really do."""

from __future__ import annotations

import pytest

from rtid.apply.tracking import foretell
from rtid.project.schema import ControllerSection
from tests.campaign.report import leave
from tests.tracking_machines import KP_1PS, follow, logged, machine, path, rms_m

MACHINES, SECONDS = 30, 20.0
SECTION = ControllerSection(kp_per_s=KP_1PS, reference="x_ref")


def judged(seed: int) -> tuple[bool, bool, float, float]:
    """Whether held and new map did as foretold; half the interval and its error, shares of it."""
    tried = machine(seed)
    ref = path(tried.plant, SECONDS, seed)
    chunk = logged(tried, follow(tried.plant, tried.held, ref, 1)[1], ref)
    told = foretell(
        tried.model, tried.plant.constants.stroke_m, SECTION, chunk, tried.learned,
        tried.beta_sd_pa, tried.new, tried.held,
    )  # fmt: skip
    held, new = (
        rms_m(follow(tried.plant, tables, ref, noise)[0], ref)
        for tables, noise in ((tried.held, 2), (tried.new, 3))
    )
    assert told.held is not None
    return (
        told.held.low_m <= held <= told.held.high_m,
        told.new.low_m <= new <= told.new.high_m,
        0.5 * (told.new.high_m - told.new.low_m) / told.new.rms_m,
        abs(new / told.new.rms_m - 1.0),
    )


@pytest.mark.campaign
def test_machines_do_what_was_foretold() -> None:
    """Nine of ten errors lie in their 95 % intervals, with either map: missed, new 26 of 30.

    Machines that oscillate as they lower their load are among them, where the mass, which nobody
    declares here, decides: what is missed is missed there.
    """
    rows = [judged(seed) for seed in range(1, MACHINES + 1)]
    held, new = (sum(row[k] for row in rows) for k in (0, 1))
    wide, off = (sorted(row[k] for row in rows)[MACHINES // 2] for k in (2, 3))
    figure = f"held {held}, new {new} of {MACHINES} in the interval; new map's: {off:.1%} off"
    leave(
        "Tracking as foretold",
        f"{figure}, half-width {wide:.1%} (medians)",
        "27 each",
        "30 plants",
    )
    assert min(held, new) >= 0.9 * MACHINES, rows
