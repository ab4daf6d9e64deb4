"""A table without pressures, or one that a pump drives: looked at without a project file."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.sources import read_table
from firmware_bridge.sources.table import to_samples
from rtid.compare.dead_band import DeadBand, dead_band, per_direction
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import INSUFFICIENT, least_evidence
from rtid.errors import RtidError
from rtid.estimator.flowmap import VALID, EdgeMap
from rtid.estimator.published import publish
from rtid.plain import Progress, plain, silent
from rtid.project import Project
from rtid.project.guess import RoleCandidate
from rtid.study.in_turn import in_turn
from rtid.study.rate_pairs import RatePair, pairs_of
from rtid.study.rate_project import of_records, placed_near, rate_text
from rtid.study.study import RecordError, Study
from rtid.trace.neutral import neutrals
from rtid.trace.quick_source import Source
from rtid.trace.reading import NoSamplesError
from rtid.trace.table import declared

SCHEMA = 1


def no_plant(path: Path, signals: list[RoleCandidate]) -> RtidError:
    """What a table has, what each kind of plant would need, and the command that goes on."""
    there = ", ".join(f"{c.name} [{c.unit or '?'}]" for c in signals[:20]) or "nothing"
    lines = (
        f"{path}: no plant is told by the names and units of its columns. It has: {there}.",
        "A cylinder with valves needs the command of the valves (u), the position of the piston (x)"
        " and the pressures of both chambers (p_a, p_b).",
        "A plant without pressures needs a command (u, in V, A, % or PWM) and what it moves (x: a "
        "position, speed, angle or temperature), which must follow the command in this record.",
        "A plant whose equations you know needs these in a file: `rtid refit PLANT.toml TABLE`.",
    )
    return RtidError("\n".join(lines), "name the columns: rtid quick FILE --role u=COLUMN "
                     "--role x=COLUMN (and p_a, p_b where there are pressures)")  # fmt: skip


@dataclass(frozen=True)
class QuickRate:
    """What a table without pressures tells: the pair that was looked at, others, the diagnosis.

    text: the project file; bands: dead band (low, high) about the neutral and gains (below, above)
    by map, in SI, NaN where the map does not tell; ranges: lowest and highest command that a map is
    known at, and what it gives there, SI; rows: those that teach, and how many a verdict takes.
    Of several records: their files, the neutral of the command in each, where one is looked for,
    and what the model leaves of each.
    """

    path: Path
    pair: RatePair
    others: tuple[RatePair, ...]
    text: str
    diagnosis: Diagnosis
    bands: dict[str, DeadBand]
    ranges: dict[str, tuple[float, float, float, float]]
    unused: tuple[str, ...]
    unit: str
    command_unit: str
    rows: tuple[int, int]
    records: tuple[Path, ...] = ()
    neutrals: tuple[float, ...] = ()
    errors: tuple[RecordError, ...] = ()

    @property
    def is_enough(self) -> bool:
        """Whether there is a verdict that the data can bear."""
        return self.diagnosis.verdict != INSUFFICIENT

    @property
    def with_more(self) -> str:
        """What to do where one record is not enough; MORE stands for another of the machine."""
        return _with_more(self.path, self.pair)

    @property
    def next_command(self) -> str:
        """What to do now."""
        held_out = [f"--held-out {error.path.name}" for error in self.errors if error.is_held_out]
        words = [*map(str, self.records or [self.path]), self.pair.options, *held_out]
        return f"rtid quick {' '.join(words)} --save machine.toml"

    def text_for(self, file: Path) -> str:
        """The project as it is written to a file: its records relative to it where they can be."""
        return placed_near(self.text, self.records, file)

    def as_json(self) -> dict[str, Any]:
        """Plain JSON types."""
        pairs = [{"u": p.command.name, "x": p.state.name, "share": p.share} for p in self.others]
        words: dict[str, Any] = plain(
            {
                "schema": SCHEMA,
                "file": str(self.path),
                "plant": "rate",
                "roles": {name: asdict(role) for name, role in self.pair.roles.items()},
                "neutral": self.pair.neutral,
                "neutrals": self.neutrals,
                "rows": self.rows,
                "others": pairs,
                "unused": list(self.unused),
                "maps": {name: asdict(band) for name, band in self.bands.items()},
                "diagnosis": self.diagnosis.as_json(),
                "next": self.next_command,
            }
            | ({"records": [asdict(error) for error in self.errors]} if self.errors else {})
        )
        return words


def _with_more(path: Path, pair: RatePair) -> str:
    return f"rtid quick {path} MORE{path.suffix} {pair.options} --save machine.toml"


def _longer(path: Path, pair: RatePair) -> str:
    """What goes on from a record too short to tell its sensors' noise."""
    return (
        f"record a minute or more of motion; several records make one fit: {_with_more(path, pair)}"
    )


def known_range(edge: EdgeMap) -> tuple[float, float, float, float] | None:
    """Lowest and highest command between which a map is known, and what it gives; None: nowhere."""
    at = np.flatnonzero((edge.status == VALID).any(axis=1))
    if not len(at):
        return None
    u = edge.grid.u_v
    ends = 0.5 * np.array([u[at[0]] + u[at[0] + 1], u[at[-1]] + u[at[-1] + 1]])
    first, last = edge.flow(ends, np.zeros(2))
    return float(ends[0]), float(ends[1]), float(first), float(last)


def quick_rate(
    path: Path,
    source: Source,
    given: Mapping[str, RoleCandidate],
    progress: Progress = silent,
    more: Sequence[Path] = (),
    held_out: Sequence[str] = (),
) -> QuickRate:
    """Judge a table without pressures.  RtidError, with a page of help, where no command moves.

    more: further records of the same fit; held_out: names of those that judge, else the last one.
    """
    if source.periods_ms or "time_column" not in source.keys:
        raise no_plant(path, source.signals)
    pairs = pairs_of(path, source, given)
    if not pairs:
        raise no_plant(path, source.signals)
    pair, *others = pairs
    text, records = rate_text(path.stem or "machine", path, source, pair, more), (path, *more)
    if more:
        text = of_records(text, records, held_out)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "machine.toml"
        file.write_text(text, "utf-8")
        study = Study(file, records, progress)
        try:
            said = in_turn(study, pair.is_proportional)
        except NoSamplesError as error:
            raise NoSamplesError(
                f"{path}: too short for a verdict, {error}", _longer(path, pair)
            ) from error
        errors, at_rest = study.record_errors, _at_rest(study.project, records)
        rows = study.fitted.regression.rows, least_evidence(study.machine)
        model, flowmap, text = study.machine, publish(study.fit.solution), file.read_text("utf-8")
    used = {role.name for role in pair.roles.values()}
    unused = tuple(s.name for s in source.signals if s.name not in used)
    gains = per_direction if pair.is_proportional else dead_band
    bands = {edge.name: gains(edge) for edge in flowmap.edges}
    units = model.chambers[0].unit, model.signals[model.column(model.edges[0].command)].unit
    ranges = {edge.name: known for edge in flowmap.edges if (known := known_range(edge))}
    several = records if more else ()
    seen = said, bands, ranges, unused
    return QuickRate(path, pair, tuple(others), text, *seen, *units, rows, several, at_rest, errors)


def _at_rest(project: Project, records: Sequence[Path]) -> tuple[float, ...]:
    """The neutral of the first command in each record, in its own unit; none where it has none."""
    samples = [to_samples(*declared(project, read_table(path)))[0] for path in records]
    return tuple(u for each in samples for u in list(neutrals(project, each).values())[:1])
