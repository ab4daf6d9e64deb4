"""What a fit can be made again from in one pass, and the classes of all that is kept."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rtid.compare.dependence import Dependence
from rtid.diagnose.clean import Cut
from rtid.diagnose.finer import on_grids
from rtid.diagnose.fit import NO_COV, Fit, one_pass
from rtid.diagnose.partial import AddedVariable, Exhibit, Rise
from rtid.diagnose.remains import Remainder
from rtid.diagnose.report import (
    Diagnosis,
    FittedEffect,
    FoundEffect,
    HiddenInMap,
    Small,
    Unseen,
    Value,
)
from rtid.diagnose.revision import Revision
from rtid.diagnose.zeros import Zero
from rtid.effects.column import Candidate
from rtid.effects.laws.pump import PUMP
from rtid.effects.laws.sensors import sensor_timings
from rtid.effects.laws.timing import Psi, timings_of
from rtid.effects.page import Effect as Page
from rtid.effects.record_view import MapTerms
from rtid.estimator.blocks import Block
from rtid.estimator.flowmap import EdgeMap
from rtid.estimator.flowmap import FlowMap as PublishedMap
from rtid.estimator.record import RecordFit
from rtid.estimator.solution import Solution
from rtid.estimator.state import Weights
from rtid.estimator.validity import Doubt
from rtid.model import Chamber, Edge, Filter, Gates, Grid, Lag, Machine, Signal, Term, Upkeep
from rtid.plain import FloatArray, IntArray
from rtid.study.known_effects import KnownEffect


@dataclass(frozen=True)
class Seed:
    """Grids, weights and revision of a fit, and the map (cells, terms) that gave its columns.

    hysteresis: as of `Gates`; timings: (effect, place, whether the spools are apart, parameters).
    Pages of effects are not kept.
    """

    grids: tuple[Grid, ...]
    hysteresis: float
    weights: Weights
    effects: tuple[Candidate, ...]
    timings: tuple[tuple[str, str, bool, Psi], ...]
    sizes: tuple[tuple[Candidate, float], ...]
    cells: IntArray
    terms: FloatArray

    @classmethod
    def of(cls, fit: Fit) -> Seed:
        """The seed of a fit."""
        revision = fit.revision
        timings = tuple((t.effect, t.where, t.own_spools, psi) for t, psi in revision.timings)
        map_ = fit.before
        effects = tuple(replace(effect, page=None) for effect in revision.effects)
        sizes = tuple((replace(effect, page=None), size) for effect, size in revision.sizes)
        grids = tuple(edge.grid for edge in fit.declared.edges)
        hysteresis = fit.declared.gates.hysteresis
        return cls(grids, hysteresis, fit.weights, effects, timings, sizes, map_.cells, map_.terms)

    def machine(self, model: Machine) -> Machine:
        """The declared machine with the blocks of the fit."""
        return on_grids(model, self.grids, self.hysteresis)

    @property
    def is_bare(self) -> bool:
        """True where nothing was added to the machine."""
        return not (self.effects or self.timings)

    def fit(
        self,
        model: Machine,
        chunk: FloatArray,
        own_effects: tuple[Page, ...] = (),
        thorough: bool = True,
    ) -> Fit:
        """The fit of the usable record that it was taken from, with its rows.

        chunk (n, 2 + signals), SI: that record.  own_effects: pages of the user's effects, which
        the catalogue does not have.  thorough: with the covariances of its maps.
        """
        pages = {effect.name: effect for effect in own_effects}

        def with_page(effect: Candidate) -> Candidate:
            return replace(effect, page=pages.get(effect.effect))

        laws = (*timings_of(model, chunk), PUMP, *sensor_timings(model))
        kinds = {(t.effect, t.where, t.own_spools, len(t.parameters)): t for t in laws}
        timings = tuple(
            (kinds[effect, at, apart, len(psi)], psi) for effect, at, apart, psi in self.timings
        )
        effects = tuple(map(with_page, self.effects))
        sizes = tuple((with_page(effect), size) for effect, size in self.sizes)
        revision = Revision(effects, timings, sizes)
        before = MapTerms(self.cells, self.terms, NO_COV)
        return one_pass(
            self.machine(model),
            chunk,
            self.weights,
            revision,
            None,
            bank=False,
            thorough=thorough,
            before=before,
        )


@dataclass(frozen=True)
class Learned:
    """A record's fit with its maps, from the fit of `seed` and the steady one.

    counters: what was refused of the trace.
    """

    record: RecordFit
    added: tuple[KnownEffect, ...]
    steady: Seed
    counters: dict[str, int]

    @classmethod
    def of(
        cls,
        record: RecordFit,
        added: tuple[KnownEffect, ...],
        steady: Fit,
        counters: dict[str, int],
    ) -> Learned:
        """What is kept of a record's fit."""
        return cls(record, added, Seed.of(steady), counters)


@dataclass(frozen=True)
class Said:
    """A diagnosis, and what was refused of its trace."""

    diagnosis: Diagnosis
    counters: dict[str, int]


FIT, LEARNED, FLOWS, SAID, EVIDENCE = "fit", "record", "map", "diagnosis", "evidence"
REMAINDER = "remainder"
_SEED = (Seed, Grid, Weights, Candidate)
_MODEL = (Machine, Signal, Chamber, Edge, Grid, Term, Lag, Filter, Gates, Upkeep)
CLASSES: dict[str, tuple[type, ...]] = {
    FIT: _SEED,
    LEARNED: (Learned, RecordFit, Solution, Block, KnownEffect, Value, *_SEED, *_MODEL),
    FLOWS: (PublishedMap, EdgeMap, Grid),
    SAID: (
        Said,
        Diagnosis,
        FittedEffect,
        FoundEffect,
        HiddenInMap,
        Unseen,
        Small,
        Value,
        Doubt,
        Cut,
        Zero,
    ),
    EVIDENCE: (Exhibit, AddedVariable, Rise, Dependence),
    REMAINDER: (Remainder, Dependence),
}
