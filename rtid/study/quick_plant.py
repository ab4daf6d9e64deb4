"""A table of a plant that empties or cools down by itself: its equations, and what they miss.

A rate that follows a command alone, dx/dt = f(u), stays where it is left.  Where the rate depends
on x too, behind what the command has filled before, a state is left out that perhaps nobody
measures: what serves then is a free run of equations (`rtid refit`), not a map.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from firmware_bridge.sources import read_table
from firmware_bridge.sources.table import held
from rtid.effects.filtering import filtered
from rtid.errors import RtidError
from rtid.plain import FloatArray, Progress, silent
from rtid.plants.missing import INSUFFICIENT, PlantDiagnosis
from rtid.plants.output_error import PlantFit
from rtid.plants.validation import left_out, rms
from rtid.project.guess import RoleCandidate
from rtid.project.plant_file import load_plant
from rtid.study.rate_pairs import RatePair, pairs_of
from rtid.study.refit import Refitted, load_records, run
from rtid.study.spans import HELD_OUT_SHARE
from rtid.study.structures import (
    ANY,
    BODIES,
    STANDS,
    TEMPERATURE,
    VESSELS,
    Structure,
    Told,
    plant_text,
)
from rtid.trace.neutral import held_out_from, slope_of
from rtid.trace.quick_source import Source
from rtid.units import COMMAND_DIMENSIONS, find_unit, split_name

MOST_ROWS = 6_000  # of a record whose free run is taken here
MOST_LOOKED, KNOTS = 2_000, 8  # samples and knots by which it is told whether x moves itself
LATE = (0, 2, 5, 10, 20, 50, 100)  # samples by which a command may act late
OWN_SHARE = 0.05  # of the rate's variance that x itself must explain
HALF = 0.5  # of the error of what stands where it is left: more is no reason to believe in losses
ALIKE_START = 0.05  # of the range: two records that begin nearer than this begin in one state
LEARN = {"est", "estimation", "id", "ident", "identification", "train", "training", "learn"}
JUDGE = {"val", "valid", "validation", "test", "testing", "check", "verify"}
WORD = re.compile(r"[A-Za-z]+")


@dataclass(frozen=True)
class Found:
    """The pair of a table, the structure that was chosen, what the table tells, the plant file."""

    pair: RatePair
    structure: Structure
    record: Told
    text: str


@dataclass(frozen=True)
class QuickPlant:
    """What a table tells of a plant by its equations, and their refit."""

    path: Path
    found: Found
    refitted: Refitted
    unused: tuple[str, ...]

    @property
    def diagnosis(self) -> PlantDiagnosis:
        """What the equations miss."""
        assert self.refitted.diagnosis is not None, "made with one"
        return self.refitted.diagnosis

    @property
    def is_enough(self) -> bool:
        """Whether there is a verdict that the data can bear."""
        return self.diagnosis.verdict != INSUFFICIENT

    @property
    def next_command(self) -> str:
        """What writes the plant file."""
        return f"rtid quick {self.path} {self.found.pair.options} --save plant.toml"

    def after(self, saved: Path) -> str:
        """What to do with the plant file."""
        added = " ".join(f"--add {effect}:{where}" for effect, where in self.refitted.last.keys)
        return f"rtid refit {saved} {self.path} {added or '--diagnose'}"


def quick_plant(
    path: Path,
    source: Source,
    given: Mapping[str, RoleCandidate],
    progress: Progress = silent,
) -> QuickPlant | None:
    """Judge a table of such a plant; None where x stands where it is left, or there is no pair."""
    found = equations_of(path, source, given, progress)
    if found is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plant.toml"
        file.write_text(found.text, "utf-8")
        plant = load_plant(file)
        records = load_records(plant, path)
        refitted = run(plant, records, with_diagnosis=True, with_limits=False, progress=progress)
    used = {*found.record.columns, *(found.record.others or ())}
    unused = tuple(s.name for s in source.signals if s.name not in used)
    return QuickPlant(path, found, refitted, unused)


def equations_of(
    path: Path,
    source: Source,
    given: Mapping[str, RoleCandidate],
    progress: Progress = silent,
) -> Found | None:
    """The equations of a table's plant; None where x stands where it is left, or of no pair."""
    found = told_of(path, source, given)
    if found is None:
        return None
    pair, record = found
    chosen = _chosen(path, record, progress)
    return Found(pair, chosen, record, plant_text(path.stem, chosen, record)) if chosen else None


def told_of(
    path: Path, source: Source, given: Mapping[str, RoleCandidate]
) -> tuple[RatePair, Told] | None:
    """The pair and its record, where x moves by itself too; None else."""
    if source.periods_ms or "time_column" not in source.keys:
        return None
    pairs = pairs_of(path, source, given)
    if not pairs or pairs[0].is_measured or pairs[0].is_proportional:
        return None
    pair, table = pairs[0], read_table(path)
    t_s = table.seconds(source.keys["time_column"], source.keys["time_unit"])
    u, y = held(t_s, table.columns[pair.command.name]), table.columns[pair.state.name]
    whole = np.isfinite(t_s) & np.isfinite(u) & np.isfinite(y)
    t_s, u, y = t_s[whole], u[whole], y[whole]
    if not (KNOTS < len(t_s) <= MOST_ROWS) or moves_itself(t_s, u, y) < OWN_SHARE:
        return None
    others = _second(pair, list(table.columns))
    starts = [table.columns[name][whole][0] for name in (pair.state.name, *(others or ())[1:])]
    is_same = abs(starts[-1] - starts[0]) <= ALIKE_START * float(np.ptp(y))
    state = next(s for s in source.signals if s.name == pair.state.name)
    unit = state.unit or split_name(state.name, COMMAND_DIMENSIONS)[1]
    pair = replace(pair, state=replace(state, unit=unit))
    units = (pair.command.unit, unit)
    split = held_out_from(t_s - t_s[0], y, HELD_OUT_SHARE) + float(t_s[0])
    columns = (pair.command.name, pair.state.name)
    quantity = _quantity(state)
    time = source.keys["time_column"]
    return pair, Told(t_s, u, y, time, columns, units, quantity, others, is_same, split)


def moves_itself(t_s: FloatArray, u: FloatArray, x: FloatArray) -> float:
    """Share of the variance of dx/dt that x explains beside a late command; t_s, u, x (n,).

    The command acts behind a lag of so many samples as explains most.
    """
    step = max(1, len(t_s) // MOST_LOOKED)
    t_s, u, x = t_s[::step], u[::step], x[::step]
    rate = slope_of(t_s, x)
    total, size = float(np.var(rate)), float(x.std())
    if total <= 0.0 or size <= 0.0:
        return 0.0
    own = (x[:, None] - x.mean()) / size  # beside hats of 1: in its own unit it was left out

    def explained(columns: FloatArray) -> float:
        left = rate - columns @ np.linalg.lstsq(columns, rate, rcond=1e-6)[0]
        return 1.0 - float(np.var(left)) / total

    best, gain = -np.inf, 0.0
    for samples in LATE:
        keep = np.exp(-1.0 / samples) if samples else 0.0
        late = filtered((1.0 - keep, 0.0, 0.0), (1.0, -keep, 0.0), u - u[0]) + u[0]
        knots = np.linspace(late.min(), late.max() + 1e-12, KNOTS)
        alone = np.stack([np.interp(late, knots, hat) for hat in np.eye(KNOTS)], axis=1)
        both = explained(np.hstack([alone, own]))
        if both > best:
            best, gain = both, both - explained(alone)
    return gain


def _chosen(path: Path, record: Told, progress: Progress) -> Structure | None:
    """The structure that foretells best what it has not seen; None where x stands where it is left.

    By the error of its free run in blocks that are left out in turn.  Two linear bodies follow a
    record of tanks that overflow closer than two vessels do, by a state of ten times the range;
    where they were not fitted they are twice as far off.  What is below zero is in no vessel, and
    no temperature either.
    """
    fits: list[tuple[Structure, PlantFit]] = []
    may_be_vessel = record.quantity == ANY and float(record.y.min()) >= 0.0
    for structure in (STANDS, *BODIES, *(VESSELS if may_be_vessel else ())):
        progress(f"trying {structure.words}", 0.05)
        with suppress(RtidError), tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "plant.toml"
            file.write_text(plant_text(path.stem, structure, record), "utf-8")
            plant = load_plant(file)
            fits.append((structure, run(plant, load_records(plant, path)).first.fit))
    if len(fits) < 2 or fits[0][0] is not STANDS:
        return None
    best, fit = min(fits[1:], key=lambda of: float(rms(left_out(of[1]))[0]))
    return best if fit.rmse[0] < HALF * fits[0][1].rmse[0] else None


def _second(pair: RatePair, columns: list[str]) -> tuple[str, str] | None:
    """Columns (u, y) of another record in the table, whose names say that they judge."""
    names = pair.command.name, pair.state.name
    shared = {w for w in WORD.findall(names[0]) if w.lower() in LEARN} & set(WORD.findall(names[1]))
    for word in shared:
        for other in JUDGE:
            found = [name.replace(word, other) for name in names]
            if set(found) <= set(columns):
                return found[0], found[1]
    return None


def _quantity(state: RoleCandidate) -> str:
    """Which effects may act on what is measured, by its unit."""
    unit = find_unit(state.unit)
    return TEMPERATURE if unit is not None and unit.dimension == TEMPERATURE else ANY
