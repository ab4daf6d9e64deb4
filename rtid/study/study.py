"""One trace under one project: everything that is made of it, when it is first asked for.

study = Study("machine.toml", "run.blf")
print(study.diagnosis().verdict)
study.add("internal_leakage_laminar:a-b")
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rtid.compare import Reference
from rtid.diagnose.clean import as_measured, usable
from rtid.diagnose.diagnosis import Result, search, searched
from rtid.diagnose.disturbance import with_disturbance
from rtid.diagnose.extend import Extension, as_diagnosed, extend
from rtid.diagnose.fit import Fit
from rtid.diagnose.partial import Exhibit, exhibits
from rtid.diagnose.parts import AddedEffect
from rtid.diagnose.remains import Remainder, remainder
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.standing import Standing, fitted, stand
from rtid.diagnose.summary import diagnosis
from rtid.diagnose.verdict import UNKNOWN
from rtid.effects import Effect
from rtid.effects.page import is_zero
from rtid.errors import door
from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.record import RecordFit
from rtid.estimator.solution import Solution
from rtid.maps.prior_map import find_prior, published
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray, Progress, silent
from rtid.project import Project, load
from rtid.project.added import AddedSection
from rtid.project.history import Change, read
from rtid.study import zeroed
from rtid.study.compared import TraceComparison
from rtid.study.compared import study as examined
from rtid.study.kept import Kept
from rtid.study.kept_record import MessageAges, Replay, aged, model_for, through_bus
from rtid.study.known_effects import KnownEffect, held_against, replayed
from rtid.study.seed import (
    CLASSES,
    EVIDENCE,
    FIT,
    FLOWS,
    LEARNED,
    REMAINDER,
    SAID,
    Learned,
    Said,
    Seed,
)
from rtid.study.spans import HELD_OUT_SHARE, added_parts, judged, taught
from rtid.study.state_run import run_error
from rtid.trace.reading import NoSamplesError, Trace, read_trace
from rtid.trace.records import (
    RecordSpan,
    TracePaths,
    read_records,
    records_of,
    rows_by_record,
    with_spans,
)

if TYPE_CHECKING:
    from rtid.study.revisions import Revised

MIN_LIVE_S = 10.0


@dataclass(frozen=True)
class Diagnosed:
    """A diagnosed trace: the search with every fit, and what is said of it."""

    project: Project
    model: Machine
    trace: Trace
    result: Result
    diagnosis: Diagnosis


@dataclass(frozen=True)
class RecordError:
    """What a model leaves of one record of several behind H_f, rms, and the flow itself, SI.

    run: rms error of the state's free run, nan for what is no rate.
    """

    path: Path
    is_held_out: bool
    left: float
    flow: float
    run: float


def _sizes(of: Residual, rows: BoolArray) -> tuple[float, float]:
    """Root mean squares of the rows (rows,) of a residual, and of their flow, SI."""
    rest, flow = (float(np.sqrt(np.mean(v[rows] ** 2))) for v in (of.left, of.measured))
    return rest, flow


class Study:
    """One trace under one project, with all effects that the project has added.

    project: as loaded, or its file.  path: a CAN log or a table, or several, of which those that
    the project holds out judge, or the last one.  progress: hears what is being done and the share
    that is done.  Raises the errors of project, trace and NoSamplesError when
    something is asked for that needs them.
    """

    @door
    def __init__(
        self,
        project: Project | str | Path,
        path: TracePaths,
        progress: Progress = silent,
        bus_speed: float | None = None,
    ) -> None:
        loaded = project if isinstance(project, Project) else load(project)
        self._take(loaded, records_of(loaded, path), progress, bus_speed)

    def _take(
        self,
        project: Project,
        paths: tuple[Path, ...],
        progress: Progress,
        bus_speed: float | None,
    ) -> None:
        """Begin with a project and its records; several are read, to know where each begins."""
        self.project, self.paths, self.path = project, paths, paths[0]
        self.progress, self.bus_speed = progress, bus_speed
        self.records: tuple[RecordSpan, ...] = ()
        if len(paths) > 1:
            progress("reading", 0.0)
            vars(self)["read"], self.records = read_records(project, paths)
            self.project = with_spans(project, self.records)

    @cached_property
    def machine(self) -> Machine:
        """The declared machine, with the sensors' noise, and what disturbs its rate if unknown."""
        model = model_for(self.project, self.read.samples, self.read.noise, self.read.crossed)
        model = replace(model, joined=len(self.records) > 1)
        if model.has_pressures:
            return model
        self.progress("what moves it beside the command", 0.1)
        chunk = taught(self.project, model, self.read)
        return with_disturbance(model, chunk, added_parts(self.project), self.project.effects)

    @property
    def trace(self) -> Trace:
        """The complete samples at the message ages that they show, and what was refused."""
        return self._aged[0]

    @cached_property
    def spans(self) -> tuple[FloatArray, FloatArray]:
        """What teaches and what judges: chunks (n, 2 + signals), [t_s, flags, signals in SI]."""
        return self.taught, judged(self.project, self.machine, self.trace)

    @cached_property
    def taught(self) -> FloatArray:
        """The part that teaches, chunk (n, 2 + signals), SI."""
        return taught(self.project, self.machine, self.trace)

    @cached_property
    def fitted(self) -> Fit:
        """The one fit of the part that teaches, what all else is made of; with rows at first."""
        seed, chunk = self._known(FIT), self.taught
        self.progress("fitting", 0.2)
        if seed is not None:
            model = as_measured(self.machine, chunk)
            return cast("Seed", seed).fit(model, usable(model, chunk), self.project.effects)
        given, suspects = added_parts(self.project), self.project.effects
        made = fitted(self.machine, chunk, given, suspects)
        self._keep(FIT, Seed.of(made))
        return made

    def _light(self) -> Fit:
        """The one fit; its rows, which are large, are let go."""
        vars(self)["fitted"] = self.fitted.light()
        return self.fitted

    @cached_property
    def replay(self) -> Replay:
        """The maps of the record beside the fit, and the record beside them."""
        made = self._relearned() or self._learned()
        vars(made)["map"] = self._published(made.fit.solution)
        if self.bus_speed is not None:
            vars(made)["live"] = self._through_bus(self.bus_speed)
        self.progress("done", 1.0)
        return made

    def _learned(self) -> Replay:
        present = self._light()
        self.progress("learning the maps", 0.5)
        made, steady = replayed(self.project, present, self.machine, *self._aged)
        vars(self)["fitted"] = replace(present, rest=None)  # it was for the steady fit
        counters = self.trace.counters
        self._keep(LEARNED, Learned.of(made.fit, made.added, steady, counters))
        return made

    def _relearned(self) -> Replay | None:
        """From what was kept; None where nothing was."""
        kept = self.kept
        if kept is None:
            return None
        model = as_measured(self.machine, self.taught)
        seed, fine, steady = kept.steady, kept.steady.machine(model), None
        if not seed.is_bare:
            chunk = usable(model, self.taught)
            steady = seed.fit(model, chunk, self.project.effects, thorough=False).light()
        known = self.machine, self.trace, kept.record, kept.added
        return held_against(self.project, fine, steady, *known)

    @property
    def kept(self) -> Learned | None:
        """What was learned from this trace before and is kept."""
        return cast("Learned | None", self._known(LEARNED))

    @property
    def fit(self) -> RecordFit:
        """Solution, weights, lag and message ages of the part that teaches."""
        return self.kept.record if self.kept else self.replay.fit

    @property
    def effects(self) -> tuple[KnownEffect, ...]:
        """The effects of the model, beside which the maps were learned."""
        return self.kept.added if self.kept else self.replay.added

    @property
    def timings(self) -> list[str]:
        """Effects of the model that act on times of signals."""
        if self.kept:
            return [name for name, *_ in self.kept.steady.timings]
        return [timing.effect for timing, _ in self.fitted.revision.timings]

    @cached_property
    def map(self) -> FlowMap:
        """The learned flow maps Q(u, dp), with the project's prior where data do not tell."""
        return self._published(self.kept.record.solution) if self.kept else self.replay.map

    def _published(self, solution: Solution) -> FlowMap:
        """Kept where no prior map has a say: that one may change."""
        prior = find_prior(self.project)
        if prior is not None:
            return published(solution, prior)
        known = self._known(FLOWS)
        if known is None:
            known = published(solution, None)
            self._keep(FLOWS, known)
        return cast("FlowMap", known)

    def comparison(self, *references: Reference | None) -> TraceComparison:
        """The learned map, and references beside it, held against both parts."""
        replay = self.replay
        self.progress("examining the maps", 1.0)
        return examined(replay, *references)

    @cached_property
    def record_errors(self) -> tuple[RecordError, ...]:
        """What the model leaves of each of several records; () of one."""
        if not self.records:
            return ()
        model, chunk = self.fitted.declared, to_chunk(self.machine, self.trace.samples, 0)
        left = residual(self.fitted, usable(model, chunk))
        return tuple(
            RecordError(
                span.path, span.is_held_out, *_sizes(left, here), self._run_off(span, chunk)
            )
            for span, here in rows_by_record(self.records, left.t_s)
        )

    def _run_off(self, span: RecordSpan, chunk: FloatArray) -> float:
        """What the free run of a state is off by on one record of a chunk, rms, SI."""
        if self.machine.has_pressures or self.machine.measured:
            return float("nan")
        part = chunk[(chunk[:, 0] >= span.start_s) & (chunk[:, 0] <= span.end_s)]
        error = run_error(self.fitted, self.map, part)
        return float(np.sqrt(np.mean(error**2)))

    @cached_property
    def diagnosed(self) -> Diagnosed:
        """The search for what is missing, with every fit."""
        result = searched(self.standing, self.progress)
        self.progress("done", 1.0)
        said = diagnosis(result)
        self._keep(SAID, Said(said, self.trace.counters))
        return Diagnosed(self.project, self.machine, self.trace, result, said)

    def diagnosis(self) -> Diagnosis:
        """Which effect is missing, how large it is, and what could not be seen."""
        return self._said.diagnosis

    @cached_property
    def _said(self) -> Said:
        known = cast("Said | None", self._known(SAID))
        return known or Said(self.diagnosed.diagnosis, self.trace.counters)

    @cached_property
    def evidence(self) -> tuple[Exhibit, ...]:
        """What the record leaves over the regressor of each effect that the diagnosis names."""
        known = cast("tuple[Exhibit, ...] | None", self._known(EVIDENCE))
        if known is None:
            known = exhibits(self.diagnosed.result)
            self._keep(EVIDENCE, known)
        return known

    @cached_property
    def remainder(self) -> Remainder | None:
        """What is left and no known effect explains; None unless that is the verdict."""
        if self.diagnosis().verdict != UNKNOWN:
            return None
        known = cast("Remainder | None", self._known(REMAINDER))
        if known is None:
            known = remainder(self.diagnosed.result.last)
            self._keep(REMAINDER, known)
        return known

    @property
    def counters(self) -> dict[str, int]:
        """What was refused of the trace, by reason."""
        known = self._known(SAID) or self._known(LEARNED)
        return known.counters if known is not None else self.trace.counters

    @cached_property
    def standing(self) -> Standing:
        """The model as it is, fitted, with every candidate beside it: what `add` begins with."""
        known, given = self.fitted, added_parts(self.project)
        suspects = self.project.all_effects
        made = stand(self.machine, *self.spans, given, self.progress, known, suspects)
        self._light()
        return made

    def rest(self) -> None:
        """Let go of what the fits make again from the record when it is asked for: 0.5 kB a sample.

        A page waits in a study for hours.
        """
        known = vars(self)
        if "diagnosed" in known:
            made = self.diagnosed.result
            made = replace(made, first=made.first.light(), last=made.last.light())
            known["diagnosed"] = replace(self.diagnosed, result=made)
        for name in ("standing", "_onward"):
            if name in known:
                known[name] = replace(known[name], fit=known[name].fit.light())
        known.pop("_tried", None)  # it can be made again of these

    def tried(self, effect: str, where: str = "") -> Extension:
        """The model with one effect more, fitted once.  Raises RefusedError."""
        made: dict[tuple[str, str], Extension] = vars(self).setdefault("_tried", {})
        if (effect, where) not in made:
            self.progress("fitting with the effect", 0.5)
            if is_zero(effect):
                made[effect, where] = zeroed.tried(self, effect, where)
            else:
                made[effect, where] = self._as_diagnosed(effect, where) or extend(
                    vars(self).get("_onward") or self.standing, effect, where
                )
        return made[effect, where]

    def _as_diagnosed(self, effect: str, where: str) -> Extension | None:
        """What the diagnosis has fitted to its end, where that was of this very model."""
        if "diagnosed" not in vars(self) or "_onward" in vars(self):
            return None
        return as_diagnosed(self.standing, self.diagnosed.result, (effect, where))

    def having(
        self, standing: Standing, sections: tuple[AddedSection, ...], is_final: bool = True
    ) -> Study:
        """The same record with another model in memory; the project file stays.

        standing: it fitted to the record; where that is not final, the next change begins there,
        and all else is made anew, as by whoever opens the project next.
        """
        project = replace(self.project, sections=replace(self.project.sections, added=sections))
        other = object.__new__(Study)
        shared = {"read", "_aged", "machine", "taught", "spans"} & vars(self).keys()
        shared |= {"paths", "path", "progress", "bus_speed", "records"}
        vars(other).update({name: vars(self)[name] for name in shared}, _place=None)
        other.project = project
        final = {"standing": standing, "fitted": standing.fit.light()}
        vars(other).update(final if is_final else {"_onward": standing})
        return other

    @property
    def revisions(self) -> list[Change]:
        """What was added to the project's model and dropped, oldest first."""
        return read(self.project.path)

    def add(self, effect: str = "", *, force: bool = False, dry_run: bool = False) -> Revised:
        """Make an effect part of the project's model, "NAME" or "NAME:PLACE".

        Without one, what the diagnosis names.  The project of this study is the one with it then.
        Raises RefusedError, with the figures, where it does not deserve its place.
        """
        from rtid.study import revisions  # noqa: PLC0415 - it is made of studies

        name, _, where = effect.partition(":")
        done = revisions.added(self, name, where, force=force, dry_run=dry_run)
        if done.is_written:
            kept = self.paths, self.progress, self.bus_speed
            vars(self).clear()
            self._take(load(done.project), *kept)
        return done

    @cached_property
    def read(self) -> Trace:
        """The complete samples at the declared message ages."""
        self.progress("reading", 0.0)
        return read_trace(self.project, self.path)

    @cached_property
    def _place(self) -> Kept | None:
        return Kept.of(self.project, self.paths)

    def _known(self, kind: str) -> Any:
        """What is kept of a kind, looked up once."""
        looked: dict[str, Any] = vars(self).setdefault("_looked", {})
        if kind not in looked:
            place = self._place
            looked[kind] = place.read(kind, CLASSES[kind]) if place is not None else None
        return looked[kind]

    def _keep(self, kind: str, value: object) -> None:
        if self._place is not None:
            self._place.write(kind, value)

    @cached_property
    def _aged(self) -> tuple[Trace, MessageAges]:
        return aged(self.project, self.machine, self.read)

    def _through_bus(self, speed: float) -> Estimator:
        return through_bus(self.project, self.machine, self.read, speed, self.progress)


@door
def diagnose_trace(project: Project, path: TracePaths, progress: Progress = silent) -> Diagnosed:
    """Diagnose one trace.  Raises NoSamplesError where there is nothing to learn from."""
    return Study(project, path, progress).diagnosed


@door
def diagnose_live(
    estimator: Estimator, more: tuple[AddedEffect, ...] = (), suspects: tuple[Effect, ...] = ()
) -> Diagnosis:
    """What is missing in a running estimator's model, by the samples in its ring buffer.

    The newest quarter is held out.  The estimator is not changed, and may go on in its thread: the
    samples are copied first.  Raises NoSamplesError without a ring buffer ([upkeep] history_s), or
    where it holds less than MIN_LIVE_S.
    """
    history = estimator.history
    chunk = history.chunk() if history is not None else np.zeros((0, 2))
    held_s = chunk[-1, 0] - chunk[0, 0] if len(chunk) else 0.0
    if held_s < MIN_LIVE_S:
        raise NoSamplesError(
            f"{held_s:.1f} s of samples are kept, a diagnosis needs {MIN_LIVE_S:g} s",
            "set upkeep.history_s in the project file, 120 for instance, and let the machine move",
        )
    held_out = chunk[:, 0] >= chunk[-1, 0] - HELD_OUT_SHARE * held_s
    spans = chunk[~held_out], chunk[held_out]
    return diagnosis(search(estimator.model, *spans, parts=more, suspects=suspects))


def compare_two(
    project: Project,
    trace: Path,
    against: Path,
    *references: Reference | None,
    progress: Progress = silent,
) -> tuple[TraceComparison, TraceComparison]:
    """Two studies side by side; their learned maps are called by the files that differ.

    against: another project (.toml) for the same trace, or another trace for the same project.
    """
    other, other_trace, names = project, against, [trace.stem, against.stem]
    if against.suffix.lower() == ".toml":
        other, other_trace, names[0] = load(against), trace, project.path.stem
    if names[0] == names[1]:
        names = [f"{name} {k}" for k, name in enumerate(names, 1)]
    first = Study(project, trace, lambda text, share: progress(text, 0.4 * share))
    second = Study(other, other_trace, lambda text, share: progress(text, 0.5 + 0.4 * share))
    return (
        examined(first.replay, *references, name=names[0]),
        examined(second.replay, name=names[1]),
    )
