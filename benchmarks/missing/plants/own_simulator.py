"""rtid's own simulated machines: random plants, valves of several laws, 14 hidden effects.

The effects are simulated in another form than the columns that look for them (`rtid.sim`).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from benchmarks.missing.plants.valve_records import RECORD_S, Simulated, case_of
from benchmarks.missing.record import LARGE, OUTSIDE, SMALL, Case, Wish
from rtid.sim.hidden import HIDDEN, MECHANICAL
from rtid.sim.hidden import OUTSIDE as UNLISTED
from rtid.sim.hideable import LEVELS
from rtid.sim.random_plants import draw, draw_hidden
from rtid.sim.run import SimulationError, simulate

RICH, POOR = "rich_record", "sweep_record"
LAWS = ("orifice", "mixed", "notch", "compensated", "flow_force")
FOURTEEN = (
    "internal_leakage_laminar", "external_leakage_laminar", "valve_seat_leakage", "entrained_air",
    "extra_dead_volume", "line_dynamics", "spool_lag_second_order", "input_delay",
    "valve_hysteresis", "supply_sag", "relief_valve", "valve_gain_drift",
    "internal_leakage_turbulent", "hose_compliance",
)  # fmt: skip
FOR_ALL = ("internal_leakage_laminar", "entrained_air", "input_delay", "supply_sag")
FEW = 3  # laws that every method gets unless the size is large
TRIES = 20  # machines that leave their stroke or cavitate are drawn anew


def wishes(size: str) -> Iterator[Wish]:
    """Clean machines of every law, then effects at three strengths, unlisted ones, mechanics."""
    if size == SMALL:
        yield _wish("mixed", RICH, "internal_leakage_laminar", "strong", True)
        return
    for k, law in enumerate(LAWS):
        yield _wish(law, RICH, for_all=k < FEW or size == LARGE)
        if law == "mixed" or size == LARGE:
            yield _wish(law, POOR, for_all=True)
    for k, effect in enumerate(FOURTEEN):
        for level in LEVELS:
            few = FOR_ALL if size == LARGE else FOR_ALL[:1]
            for_all = effect in few and level == "strong"
            yield _wish(LAWS[k % len(LAWS)], RICH, effect, level, for_all)
    for effect in (*UNLISTED, *MECHANICAL):
        yield _wish("orifice", RICH, effect, "middle")


def _wish(law: str, motion: str, effect: str = "", level: str = "", for_all: bool = False) -> Wish:
    name = " ".join(word for word in ("own", law, motion.partition("_")[0], effect, level) if word)
    return Wish(name, partial(_draw, name, law, motion, effect, level, for_all))


def _draw(
    name: str, law: str, motion: str, effect: str, level: str, for_all: bool, seed: int
) -> Case | None:
    for k in range(TRIES):
        number = seed + k
        plant = draw_hidden(number, effect, level, law=law) if effect else draw(number, law=law)
        try:
            run = simulate(plant, motion, number, RECORD_S)
        except SimulationError:
            continue
        truth = run.truth
        simulated = Simulated(plant, run.samples.values, truth.signals, truth.opening_v, plant.flow)
        return case_of(
            simulated, number, called(effect), name=name, simulator="rtid", law=law,
            motion=motion.partition("_")[0], hidden=effect, level=level, for_all=for_all,
        )  # fmt: skip
    return None


def called(effect: str) -> str:
    """The catalogue's name of what is hidden: OUTSIDE for what it does not know."""
    if effect in UNLISTED:
        return OUTSIDE
    return "" if not effect or effect in MECHANICAL else HIDDEN[effect].catalogue
