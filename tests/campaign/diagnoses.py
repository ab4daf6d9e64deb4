"""One simulated machine with something hidden in it, diagnosed and judged against the truth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from math import sqrt
from multiprocessing import get_context

from rtid.diagnose.diagnosis import search
from rtid.diagnose.report import OVER, Diagnosis, FoundEffect, Value
from rtid.diagnose.summary import diagnosis
from rtid.diagnose.verdict import MATERIAL
from rtid.estimator.chunk import to_chunk
from rtid.sim.declare import declared_model
from rtid.sim.hidden import HIDDEN, MECHANICAL, OUTSIDE, hide
from rtid.sim.random_plants import draw, draw_hidden
from rtid.sim.run import SimulationError, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.campaign.plants import WORKERS, grid

RECORD_S, LEARN_S, TEST_S = 110.0, 80.0, 83.0
NONE = "none"
LARGEST_SET = 3  # causes that an honest set may have

RIGHT, IN_SET, NEGLIGIBLE, SILENT, UNKNOWN, WRONG, HALF = (
    "right", "in a set", "negligible", "not seen", "unknown", "wrong name", "one of two"
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """What is drawn: the machine's number, what is hidden, how much of it, the motion.

    second: another effect, hidden beside the first.
    """

    seed: int
    effect: str = NONE
    level: str = "middle"
    motion: str = "rich_record"
    second: str = ""

    @property
    def plant(self) -> SimulatedPlant:
        """The machine."""
        if self.effect == NONE:
            return draw(self.seed)
        plant = draw_hidden(self.seed, self.effect, self.level)
        if not self.second:
            return plant
        (more,) = draw_hidden(self.seed, self.second, self.level).hidden
        return hide(plant, more.name, more.strength, more.where)


@dataclass(frozen=True)
class Outcome:
    """A judged diagnosis; named: the first effect that was named, "" where none was.

    size: the first effect's size over the true one, NaN where it is not one number; left_pct: of
    the rms flow on the held-out part, with everything found.
    """

    case: Case
    judgement: str
    named: str
    verdict: str
    rho_before: float
    rho_after: float
    size: float
    left_pct: float


def outcomes(cases: Iterable[Case]) -> Iterator[Outcome]:
    """Outcomes of all machines that could be simulated, on WORKERS processes."""
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        for found in pool.map(outcome, cases):
            if found is not None:
                yield found


def outcome(case: Case) -> Outcome | None:
    """One case; None where the drawn machine leaves its stroke or cavitates."""
    plant = case.plant
    try:
        run = simulate(plant, case.motion, case.seed, RECORD_S)
    except SimulationError:
        return None
    model = declared_model(plant, seed=case.seed, grid=grid(plant.p_supply_pa))
    chunk = to_chunk(model, run.samples, 0)
    t_s = chunk[:, 0]
    found = diagnosis(search(model, chunk[t_s < LEARN_S], chunk[t_s >= TEST_S]))
    named = found.found[0].effect if found.found else ""
    left_pct = 100.0 * found.heldout_residual_after_m3s / max(found.rms_flow_m3s, 1e-12)
    return Outcome(
        case, judge(case, found), named, found.verdict, found.rho_before, found.rho_after,
        _size(plant, found), left_pct,
    )  # fmt: skip


def _size(plant: SimulatedPlant, diagnosed: Diagnosis) -> float:
    """What was found of the first effect over what was hidden, where one number is its size."""
    if not diagnosed.found or not plant.hidden:
        return float("nan")
    own, true = diagnosed.found[0], plant.hidden[0]
    value, *shape = own_numbers(own)
    alike = not shape and own.effect == truth(true.name) and value.unit == HIDDEN[true.name].unit
    return abs(value.value / true.strength) if alike else float("nan")


def own_numbers(effect: FoundEffect) -> tuple[Value, ...]:
    """The numbers of an effect: the time that a change is told over is none of it."""
    return tuple(value for name, value in effect.parameters.items() if name != OVER)


def truth(effect: str) -> str:
    """The catalogue's name of what was hidden, "" for nothing that the catalogue knows."""
    if effect == NONE or effect in OUTSIDE or effect in MECHANICAL:
        return ""
    return HIDDEN[effect].catalogue or effect


def judge(case: Case, diagnosed: Diagnosis) -> str:
    """What the diagnosis is worth."""
    true = truth(case.effect)
    if case.second:
        return _judge_two({true, truth(case.second)}, diagnosed)
    if not diagnosed.found:
        if diagnosed.verdict == "unknown":
            return UNKNOWN
        return NEGLIGIBLE if case.effect != NONE and excess(diagnosed) < MATERIAL else SILENT
    sets = [{e.effect, *(n.split(" ")[0] for n in e.cannot_be_told_from)} for e in diagnosed.found]
    if not all(true in one for one in sets) or any(len(one) > LARGEST_SET for one in sets):
        return WRONG  # a false name beside the right one is as wrong as alone
    return RIGHT if all(len(one) == 1 for one in sets) else IN_SET


def _judge_two(true: set[str], diagnosed: Diagnosis) -> str:
    """Both named, one of them, or neither; a third name is wrong."""
    sets = [{e.effect, *(n.split(" ")[0] for n in e.cannot_be_told_from)} for e in diagnosed.found]
    if any(not one & true for one in sets):
        return WRONG
    if all(any(name in one for one in sets) for name in true):
        return RIGHT
    return HALF if sets else UNKNOWN


def excess(diagnosed: Diagnosis) -> float:
    """What the model leaves of the held-out part beyond the sensors' noise, of the rms flow."""
    left = diagnosed.heldout_residual_before_m3s**2 - diagnosed.noise_floor_m3s**2
    return sqrt(max(0.0, left)) / max(diagnosed.rms_flow_m3s, 1e-12)


def wilson(hits: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    if n == 0:
        return 0.0, 1.0
    p = hits / n
    middle, half = p + z * z / (2 * n), z * sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)
