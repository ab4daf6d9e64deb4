"""What a report tells: diagnosis, residuals before and after, ranking, history."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from rtid.apply.judge import KnownMap
from rtid.apply.plan import edge_tables
from rtid.apply.tracking import told
from rtid.apply.versions import Applied
from rtid.compare import Dependence, against_signals, over_time
from rtid.diagnose.clean import usable
from rtid.diagnose.diagnosis import Result
from rtid.diagnose.fit import Fit
from rtid.diagnose.fitted_sizes import parameters
from rtid.diagnose.regression import Score
from rtid.diagnose.remains import filtered
from rtid.diagnose.report import Diagnosis, Unseen
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.sized import physical
from rtid.diagnose.trials import scored
from rtid.diagnose.verdict import LEAST_ROWS
from rtid.effects.column import Candidate
from rtid.estimator.flowmap import FlowMap
from rtid.maps.lookup import sample
from rtid.model import Machine
from rtid.plain import FloatArray, Key, Progress, silent
from rtid.project import Project
from rtid.project.folder import state_folder
from rtid.project.history import Change, read
from rtid.study.study import Diagnosed, Study
from rtid.tell.charts.evidence import charts_of
from rtid.tell.charts.points import spread_points
from rtid.tell.story import Chart

SIGNALS = 5  # against which the residual is shown
POINTS = 400  # of the data, on a map


@dataclass(frozen=True)
class Ranked:
    """A candidate: effect and place, clarity in standard deviations before and after (None: found).

    value, std, unit: its coefficient beside the last model, or as fitted; is_possible: of a sign
    and size that physics allows; per_shape: the value of a timing
    of which the coefficient is a share; unseen: what of it would have been found, where it was not.
    """

    key: Key
    before: float | None
    after: float | None
    value: float
    std: float
    unit: str
    is_possible: bool = True
    per_shape: tuple[float, str] | None = None
    unseen: Unseen | None = None


def sizes_say(ranking: Sequence[Ranked], noun: str) -> str:
    """Beside what the sizes of a ranking are fitted; noun: what its column is called."""
    if any(candidate.after is None for candidate in ranking):
        return f"Each {noun} is what is left of it once what was found is in the model."
    return f"Each {noun} is that of the effect added alone."


@dataclass(frozen=True)
class ReportStory:
    """What a report tells: the diagnosis, the residual of both parts before and after, the ranking.

    after is None and depends_after is empty where nothing was found.  tracking: what the
    map will do to it, "" without a section [controller].  points: of the data that taught each map,
    (n, 2) in V and MPa.
    """

    diagnosed: Diagnosed
    chambers: tuple[str, ...]
    before: tuple[Residual, Residual]
    after: tuple[Residual, Residual] | None
    depends_before: tuple[Dependence, ...]
    depends_after: tuple[Dependence, ...]
    ranking: tuple[Ranked, ...]
    evidence: tuple[Chart, ...]
    flowmap: FlowMap
    history: tuple[Change, ...]
    trace_sha256: str
    date: str
    tracking: str
    points: dict[str, FloatArray]

    @property
    def judges(self) -> int:
        """The part that judges: the held-out one, or 0, the record, where too little is known."""
        return 1 if len(self.before[1].t_s) >= LEAST_ROWS else 0


def tell(project: Project, trace: Path, progress: Progress = silent) -> ReportStory:
    """Diagnose a trace once and gather what its report shows."""
    study = Study(project, trace, progress)
    diagnosed = study.diagnosed
    first, last = diagnosed.result.first, diagnosed.result.last
    chunks = [usable(first.declared, part) for part in study.spans]
    before = _both(first, chunks)
    after = _both(last, chunks) if diagnosed.diagnosis.found else None
    depends = _telling(
        first.declared,
        _depends(first.declared, before, chunks),
        _depends(first.declared, after, chunks) if after else (),
    )
    return ReportStory(
        diagnosed,
        tuple(chamber.name for chamber in diagnosed.model.chambers),
        before,
        after,
        *depends,
        ranked(diagnosed.result, diagnosed.diagnosis),
        charts_of(study.evidence, study.remainder),
        study.map,
        tuple(read(project.path)),
        _sha256(trace),
        datetime.now().astimezone().isoformat(" ", "seconds"),
        _tracking(study),
        {e.name: spread_points(study.machine, e, study.taught, POINTS) for e in study.machine.maps},
    )


def _tracking(study: Study) -> str:
    """Tracking over the held-out part, or the record, with the held map and the learned one."""
    project, solution = study.project, study.fit.solution
    section = project.sections.controller
    if section is None:
        return ""
    applied = Applied(state_folder(project))
    last = applied.newest()
    held = None if last is None else edge_tables(project, applied.images(last.content))
    new = {edge.name: sample(edge, study.map[edge.name]).table for edge in project.model.edges}
    known = KnownMap(study.map, solution.beta_pa)
    foretold = ""
    for span in reversed(study.spans):
        result = told(project, section, span, known, solution.beta_sd_pa, new, held)
        foretold = result if isinstance(result, str) else result.sentence
        if not isinstance(result, str):
            break
    return foretold


def _both(fit: Fit, chunks: list[FloatArray]) -> tuple[Residual, Residual]:
    return residual(fit, chunks[0]), residual(fit, chunks[1])


def _depends(
    model: Machine, both: tuple[Residual, Residual], chunks: list[FloatArray]
) -> tuple[Dependence, ...]:
    """The residual of both parts against every signal that varies, and time; () without."""
    t_s = np.concatenate([part.t_s for part in both])
    if not len(t_s):
        return ()
    measured, rest = (
        np.concatenate([getattr(part, name) for part in both]) for name in ("measured", "left")
    )
    chunk = np.concatenate(chunks)
    chunk = chunk[np.argsort(chunk[:, 0], kind="stable")]
    part = filtered(model, Residual(t_s, measured, rest, np.zeros_like(rest)), chunk)
    return (*against_signals(model, part), over_time(part))


def _telling(
    model: Machine, before: tuple[Dependence, ...], after: tuple[Dependence, ...]
) -> tuple[tuple[Dependence, ...], tuple[Dependence, ...]]:
    """Of both: position, chamber pressures, the signals on which the first depends most, time."""
    always = {model.position, *(c.pressure for c in model.chambers)}
    by_share = sorted(
        before[:-1], key=lambda d: (d.signal not in always, -float(d.explained.max()))
    )
    shown = {d.signal for d in [*by_share[:SIGNALS], *before[-1:]]}
    first, second = (
        tuple(d for d in dependences if d.signal in shown) for dependences in (before, after)
    )
    return first, second


def ranked(result: Result, diagnosis: Diagnosis) -> tuple[Ranked, ...]:
    """The clearest candidates of the first model, and what became of them."""
    before = {key: np.sqrt(score.gain) for key, (_, score) in _best(result.first).items()}
    last = _best(result.last)
    inside = {accepted.key for accepted in result.found}  # a sensor's zero is no column of the fit
    unseen = {(u.effect, u.where): u for u in diagnosis.not_found if u.visible}
    ranked = []
    for key in {**before, **last, **dict.fromkeys(inside)}:
        last_rank = (
            _fitted(result.last, key) if key in inside else _scored(result.last, last.get(key))
        )
        if last_rank is None:
            continue
        sd = before.get(key)
        clear = None if sd is None else float(sd)
        ranked.append(replace(last_rank, key=key, before=clear, unseen=unseen.get(key)))
    ranked.sort(key=lambda r: (r.key not in inside, -(r.before or r.after or 0.0)))
    return tuple(ranked)


def _best(fit: Fit) -> dict[Key, tuple[Candidate, Score]]:
    """The clearest column of every cause beside a fit."""
    best: dict[Key, tuple[Candidate, Score]] = {}
    for candidate, score in scored(fit):
        known = best.get(candidate.key)
        if score.gain > 0 and (known is None or score.gain > known[1].gain):
            best[candidate.key] = candidate, score
    return best


def _scored(fit: Fit, scores: tuple[Candidate, Score] | None) -> Ranked | None:
    """A candidate beside the last model; None where the record does not hold it."""
    if scores is None:
        return None
    candidate, score = scores
    value, std = (physical(fit, candidate, v) for v in (score.value, score.sd))
    timing = candidate.parameter == "share" and bool(candidate.shape)
    here = fit.declared.unit_here
    per = (candidate.shape[0], here(candidate.shape_units[0])) if timing else None
    return Ranked(
        candidate.key,
        None,
        float(np.sqrt(score.gain)),
        value,
        std,
        here(candidate.unit),
        candidate.is_possible(score.value),
        per,
    )


def _fitted(fit: Fit, key: Key) -> Ranked | None:
    """An effect that is part of the last model, by its first parameter."""
    first = next(iter(parameters(fit, key).values()), None)
    return None if first is None else Ranked(key, None, None, first.value, first.std, first.unit)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
