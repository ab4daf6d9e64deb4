"""A clean machine whose valves follow any law, judged as its user would see it.

Drawn at random: the law's numbers, areas and spools, the sensors' noise, the motion, and the grid:
the simulator's own, equal steps that somebody has thought of, or the file of `rtid init`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Protocol, TypeVar

import numpy as np

from rtid.diagnose.diagnosis import searched
from rtid.diagnose.excuse import steady
from rtid.diagnose.fit import Fit
from rtid.diagnose.report import OVER, Diagnosis, Unseen
from rtid.diagnose.standing import fitted, stand
from rtid.diagnose.summary import diagnosis
from rtid.effects.laws import causes
from rtid.effects.laws.timing import RATES
from rtid.estimator.chunk import to_chunk
from rtid.estimator.flowmap import EXTRAPOLATED, VALID, EdgeMap
from rtid.estimator.published import publish
from rtid.estimator.solution import Solution
from rtid.model import Edge, Grid, Lag, Machine
from rtid.plain import FloatArray, Key
from rtid.project.template import U_STEPS, nice
from rtid.sim.declare import declared_model, default_grid
from rtid.sim.demand import IDENTIFICATION, VALIDATION
from rtid.sim.extra_physics import Planted
from rtid.sim.hidden import HIDDEN, hide
from rtid.sim.random_plants import draw, draw_hidden
from rtid.sim.run import Run, Sensors, SimulationError, simulate
from rtid.sim.simulated_plant import EDGES, SimulatedPlant
from rtid.study.known_effects import learn_acting
from tests.campaign import diagnoses
from tests.campaign.diagnoses import judge, own_numbers, truth

WORKERS = int(os.environ.get("RTID_WORKERS", "2"))
RECORD_S = 44.0  # of which 32 s teach
WARM = 1.5  # records: time constant with which the gains drift
NEAR = 0.25  # of the visited span: how far off the data a map still gives a number
DEFAULT, EQUAL, INIT = "default", "equal", "init"
GRIDS = (DEFAULT, EQUAL, INIT)
T = TypeVar("T")


@dataclass(frozen=True)
class Case:
    """One machine: its number, its valves' law and its motion; what is hidden in it, "" for none.

    size: of what is hidden, SI; 0: of middle strength, in a random place.
    """

    seed: int
    law: str
    motion: str = "rich_record"
    hidden: str = ""
    size: float = 0.0

    @property
    def plant(self) -> SimulatedPlant:
        """The machine."""
        if self.hidden and not self.size:
            return draw_hidden(self.seed, self.hidden, law=self.law)
        plant = draw(self.seed, law=self.law)
        return hide(plant, self.hidden, self.size) if self.hidden else plant

    @property
    def sensors(self) -> Sensors:
        """Its sensors' noise: three times worse or better than usual."""
        p, x = np.exp(np.random.default_rng([self.seed, 9]).uniform(-1.0, 1.0, 2))
        usual = Sensors()
        return replace(usual, p_noise_pa=p * usual.p_noise_pa, x_noise_m=x * usual.x_noise_m)

    @property
    def grid(self) -> str:
        """Who has written its grid."""
        return GRIDS[self.seed % len(GRIDS)]


@dataclass(frozen=True)
class Points:
    """Errors of the map at points, in standard deviations and as shares of the largest flow.

    half: of the 95 % interval, as such a share; all (n,).
    """

    z: FloatArray
    error: FloatArray
    half: FloatArray


class Hiding(Protocol):
    """A machine by its number, its valves' law, its motion, and what is hidden in it."""

    @property
    def seed(self) -> int: ...

    @property
    def law(self) -> str: ...

    @property
    def motion(self) -> str: ...

    @property
    def hidden(self) -> str: ...


class TruePlant(Protocol):
    """What is known of a machine that is judged: its bulk modulus, and its maps in m3/s."""

    @property
    def beta_pa(self) -> float: ...

    def flow(self, edge: str, w_v: FloatArray, dp_pa: FloatArray, /) -> FloatArray: ...


@dataclass(frozen=True)
class Outcome:
    """What was said of a machine, beside the truth.

    beta_z, beta_half (chambers,): error in standard deviations, half-width as a share; names: of
    all that was found and what it cannot be told from; limits: (effect, where) -> size from
    which on it would be named;
    left: of the held-out part, in units of the sensors' noise.
    """

    case: Hiding
    verdict: str
    names: tuple[str, ...]
    rho: float
    dof: float
    beta_z: FloatArray
    beta_half: FloatArray
    valid: Points
    near: Points
    limits: dict[tuple[str, str], float]
    seconds: float
    left: float

    @property
    def band(self) -> float:
        """How far rho may be off 1: 3 sqrt(2 / dof)."""
        return 3.0 * float(np.sqrt(2.0 / self.dof))


@dataclass(frozen=True)
class Answer:
    """What was said of a machine with an effect of middle strength in it.

    judgement: as of `diagnoses.judge`; is_hidden: named where the maps had taken it in; size_z:
    error of its size in stated standard deviations, NaN where it is not one number; beta_z, half
    (chambers,) as of an outcome; left: of the held-out part, in units of the sensors' noise;
    of_limit: the size that is hidden over the one from which the record says that it is named, 0
    where it says that no possible one would be; NaN where the record names it, or cannot be asked.
    clean_left: what the same machine leaves without the effect, where it is named.
    """

    case: Case
    judgement: str
    verdict: str
    named: str
    is_hidden: bool
    size_z: float
    size_half: float
    beta_z: FloatArray
    beta_half: FloatArray
    left: float
    seconds: float
    of_limit: float = float("nan")
    clean_left: float = float("nan")


@dataclass(frozen=True)
class Judged:
    """A record, the fit of its first part and what a search has found; the machine behind it."""

    plant: TruePlant
    run: Run
    present: Fit
    taught: FloatArray
    said: Diagnosis
    last: Fit


def outcomes(cases: Iterable[Case]) -> Iterator[Outcome]:
    """Outcomes of all machines that could be simulated, on WORKERS processes."""
    return _all(outcome, cases)


def answers(cases: Iterable[Case]) -> Iterator[Answer]:
    """Answers to all machines that could be simulated, on WORKERS processes."""
    return _all(answer, cases)


def _all(of: Callable[[Case], T | None], cases: Iterable[Case]) -> Iterator[T]:
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        for found in pool.map(of, cases, chunksize=2):
            if found is not None:
                yield found


def judged(case: Case) -> Judged | None:
    """One case through the diagnosis; None where the machine leaves its stroke or cavitates."""
    plant = case.plant
    try:
        run = simulate(plant, case.motion, case.seed, RECORD_S, case.sensors)
    except SimulationError:
        return None
    return of_run(plant, run, declared(case, run))


def of_run(plant: TruePlant, run: Run, model: Machine) -> Judged:
    """A run of a plant through the diagnosis, declared as this model."""
    chunk = to_chunk(model, run.samples, 0)
    t_s = chunk[:, 0]
    taught = chunk[t_s < IDENTIFICATION * RECORD_S]
    present = fitted(model, taught)
    standing = stand(model, taught, chunk[t_s >= VALIDATION * RECORD_S], known=present)
    result = searched(standing)
    return Judged(plant, run, present, taught, diagnosis(result), result.last)


def answer(case: Case) -> Answer | None:
    """The answer to one case; None where it could not be simulated."""
    began = time.process_time()
    found = judged(case)
    if found is None:
        return None
    said = answer_of(case, found, began)
    if said.judgement not in (diagnoses.RIGHT, diagnoses.IN_SET):
        return said
    return replace(said, clean_left=left_without(case))


def left_without(case: Case) -> float:
    """What a machine leaves of the held-out part, in units of the noise, without the effect."""
    bare = replace(case, hidden="", size=0.0)
    try:
        run = simulate(bare.plant, bare.motion, bare.seed, RECORD_S, bare.sensors)
    except SimulationError:
        return float("nan")
    model = declared(bare, run)
    chunk = to_chunk(model, run.samples, 0)
    t_s = chunk[:, 0]
    taught, judging = chunk[t_s < IDENTIFICATION * RECORD_S], chunk[t_s >= VALIDATION * RECORD_S]
    residual = stand(model, taught, judging).held_out
    return residual.rms_m3s / residual.floor_m3s


def answer_of(case: Case, found: Judged, began: float = float("nan")) -> Answer:
    """The answer to a case that was judged; began: processor time before that, s."""
    said, z, half = found.said, float("nan"), float("nan")
    judgement = judge(diagnoses.Case(case.seed, case.hidden), said)
    first = said.found[0] if said.found else None
    sizes = own_numbers(first) if first is not None else ()
    if first is not None and first.effect == truth(case.hidden) and len(sizes) == 1:
        true = _over_the_record(found, (first.effect, first.where))
        true = true if np.isfinite(true) else case.plant.hidden[0].strength * _taught(case)
        (size,) = sizes
        z, half = (abs(size.value) - abs(true)) / size.std, 1.96 * size.std / abs(true)
    is_hidden = first is not None and first.hidden_in_map is not None
    true, solution = case.plant.constants.beta_pa, told(found.last)
    beta, sd = solution.beta_pa, solution.beta_sd_pa
    left = said.heldout_residual_after_m3s / said.noise_floor_m3s
    return Answer(
        case, judgement, said.verdict, first.effect if first else "", is_hidden, z, half,
        (beta - true) / sd, 1.96 * sd / true, left, time.process_time() - began,
        of_limit(case.plant.hidden[0], said.not_found),
    )  # fmt: skip


def of_limit(hidden: Planted, unseen: Iterable[Unseen]) -> float:
    """A hidden size over the one from which a record says that it is named, as of `Answer`.

    A slow spool is the stronger the lower its frequency; what sits in no chamber, or in both, is
    asked for where it would be named; a share that boils out has another unit on its page, and what
    opens at a pressure has a limit for another one than the hidden one's.
    """
    true = truth(hidden.name)
    limits = {u.where: u for u in unseen if u.effect == true and u.examined}
    at = limits.get(hidden.where or "both")
    if at is None and len(limits) == 1:
        (at,) = limits.values()
    if at is None or set(at.form) - {OVER} or HIDDEN[hidden.name].unit != at.unit:
        return float("nan")
    if at.named_from is None:
        return 0.0
    size = hidden.strength / at.named_from
    return 1.0 / size if at.unit in RATES else size


def told(fit: Fit) -> Solution:
    """The maps and moduli of a fit, with the intervals that replay tells."""
    words = steady(fit)
    return learn_acting(words, words.chunk)[1].solution


def _taught(case: Case) -> float:
    """The share of an effect that the taught part holds: gains warm up over the whole record."""
    if not case.hidden.startswith("valve_gain_drift"):
        return 1.0
    return float(np.expm1(-IDENTIFICATION / WARM) / np.expm1(-1.0 / WARM))


def _over_the_record(found: Judged, key: Key) -> float:
    """The coefficient that a plain column has of the true flow past the valves; NaN for another.

    A gap widens with pressure: what it lets through at 3 MPa is not its size in a record at 1 MPa.
    """
    view, n = found.present.view, found.present.view.n
    plain = [c for c in causes(view) if c.candidate.key == key and not c.axes]
    past = found.run.truth.extra_m3s[:n]
    if not plain or not past.any():
        return float("nan")
    column = plain[0].column(())
    true = {c: 0.5 * (past[1:, c] + past[:-1, c]) * view.dt_s for c in column}
    return float(sum(column[c] @ true[c] for c in column) / sum(v @ v for v in column.values()))


def outcome(case: Case) -> Outcome | None:
    """One case; None where the drawn machine leaves its stroke or cavitates."""
    began = time.process_time()
    found = judged(case)
    return None if found is None else outcome_of(case, found, began)


def outcome_of(case: Hiding, judgement: Judged, began: float) -> Outcome:
    """What was said beside the truth; began: the processor time at the start, s."""
    plant, run, present = judgement.plant, judgement.run, judgement.present
    said = judgement.said
    solution = told(present)
    flowmap, n = publish(solution), len(judgement.taught)
    pairs = zip(solution.model.edges, flowmap.edges, strict=True)
    of = [_points(edge, learned, plant, run, n) for edge, learned in pairs]
    return Outcome(
        case,
        said.verdict,
        tuple(name for f in said.found for name in (f.effect, *f.cannot_be_told_from)),
        present.rho,
        present.freedom,
        (solution.beta_pa - plant.beta_pa) / solution.beta_sd_pa,
        1.96 * solution.beta_sd_pa / plant.beta_pa,
        _joined([valid for valid, _ in of]),
        _joined([near for _, near in of]),
        {(u.effect, u.where): u.named_from or np.inf for u in said.not_found},
        time.process_time() - began,
        said.heldout_residual_after_m3s / said.noise_floor_m3s,
    )


def declared(case: Case, run: Run) -> Machine:
    """The machine as its user declares it."""
    plant, rng = case.plant, np.random.default_rng([case.seed, 10])
    if case.grid == INIT:
        top = nice(float(run.samples.column("p_supply").max()) * 1e-6, 10.0) * 1e6
        grid = Grid(np.linspace(0.0, 10.0, U_STEPS + 1), np.linspace(0.0, top, 21))
        model = declared_model(plant, grid=grid, sensors=case.sensors, seed=case.seed)
        edges = tuple(replace(edge, safe_band_v=0.0) for edge in model.edges)
        return replace(model, edges=edges, lag=Lag(0.0, 5e-3))
    grid = default_grid(1.25 * plant.p_supply_pa)
    if case.grid == EQUAL:
        u_v = np.linspace(1.0, 10.0, int(rng.integers(24, 46)))
        top = 1.25 * plant.p_supply_pa
        grid = Grid(u_v, np.linspace(-0.5e6, top, int(rng.integers(12, 24))))
    return declared_model(plant, grid=grid, sensors=case.sensors, seed=case.seed)


def _points(
    edge: Edge, learned: EdgeMap, plant: TruePlant, run: Run, n: int
) -> tuple[Points, Points]:
    """The map of an edge at four points per cell: valid ones, and extrapolated ones near the data.

    The first n samples have taught it.
    """
    s, names = run.truth.signals[:n], run.samples.names
    w = run.truth.opening_v[:n, EDGES.index(edge.name)]
    dp = s[:, names.index(edge.source)] - s[:, names.index(edge.sink)]
    dp, largest = dp[w > edge.safe_band_v], float(np.abs(run.truth.flow(edge.name)[:n]).max())
    at_w, at_dp = (_inner(b) for b in (learned.grid.u_v, learned.grid.dp_pa))
    at_w, at_dp = (a.ravel() for a in np.meshgrid(at_w, at_dp, indexing="ij"))
    error = learned.flow(at_w, at_dp) - plant.flow(edge.name, at_w, at_dp)
    sd, status = learned.sd(at_w, at_dp), learned.status_at(at_w, at_dp)
    z = error / np.maximum(sd, 1e-15)
    close = _near(at_w, w[w > edge.safe_band_v]) & _near(at_dp, dp)
    of = (status == VALID), (status == EXTRAPOLATED) & close
    first, second = (Points(z[k], error[k] / largest, 1.96 * sd[k] / largest) for k in of)
    return first, second


def _inner(border: FloatArray) -> FloatArray:
    """Two points in each interval."""
    return np.sort(np.concatenate([border[:-1] + s * np.diff(border) for s in (0.25, 0.75)]))


def _near(at: FloatArray, visited: FloatArray) -> np.ndarray:
    low, high = visited.min(), visited.max()
    reach = NEAR * (high - low)
    return (at >= low - reach) & (at <= high + reach)


def _joined(parts: list[Points]) -> Points:
    columns = (np.concatenate([getattr(p, n) for p in parts]) for n in ("z", "error", "half"))
    return Points(*columns)
