"""How often the plant watch cries wolf, and what it misses, on plants nobody has set it with.

`make campaign` draws all; RTID_PLANTS makes it fewer.
"""

from __future__ import annotations

import os

import pytest

from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.run import PlantChange
from tests.campaign.diagnoses import wilson
from tests.campaign.report import leave
from tests.campaign.watching import watched

PLANTS = int(os.environ.get("RTID_PLANTS", "30"))
FIRST = 5000  # the thresholds were set on plants of small numbers
SECONDS, BEGINS_S = 150.0, 70.0
EFFECTS = ("internal_leakage_laminar", "entrained_air", "input_delay", "spool_lag_first_order")

pytestmark = pytest.mark.campaign


def test_false_alarms_of_the_plant_watch() -> None:
    """So few hours only bound the rate: the interval is told with it."""
    found = [watched(draw(FIRST + k), k, SECONDS) for k in range(PLANTS)]
    alarms = sum(one.alarm_s is not None for one in found)
    hours = sum(one.judged_s for one in found) / 3600
    low, high = wilson(alarms, PLANTS)
    worst = sorted(one.worst for one in found)
    said = (
        f"{alarms} of {PLANTS} plants ({100 * low:.0f} to {100 * high:.0f} %), {hours:.2f} h "
        "judged; largest surprise over its level: "
        f"median {worst[len(worst) // 2]:.2f}, most {worst[-1]:.2f}"
    )
    print(said)
    leave("plant watch: alarms on healthy plants", said, "none", f"rich motion, {SECONDS:g} s each")
    assert alarms == 0


@pytest.mark.parametrize("effect", EFFECTS)
def test_changes_that_the_plant_watch_notices(effect: str) -> None:
    found = []
    for k in range(max(2, PLANTS // 5)):
        plant = draw(FIRST + 100 + k)
        change = PlantChange(BEGINS_S, hide_wish(plant, f"{effect}=middle"))
        found.append(watched(plant, k, SECONDS, change=change))
    after = [one.alarm_s - BEGINS_S for one in found if one.alarm_s is not None]
    noticed = [s for s in after if s >= 0]
    said = f"{len(noticed)} of {len(found)}, after {max(noticed, default=0):.0f} s at most"
    print(said)
    leave(f"plant watch: {effect} begins, middle", said, "", f"rich motion, {SECONDS:g} s each")
    assert len(noticed) == len(after)
