"""Ours: rtid's map, rtid with what its diagnosis has added, and plain block RLS (`carry`).

All three are asked in the same way: the map that they publish, with the effects that they have
found, is held against the unseen record; what the balance of flows lacks there is what the
pressure rate misses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.missing.methods.data_sheet import sheet_flow
from benchmarks.missing.record import NOTHING, UNKNOWN, Learned, Names, NotForThisError, Record
from rtid.compare.candidate import CandidateMap
from rtid.compare.candidate import learned as candidate_of
from rtid.diagnose.clean import usable
from rtid.diagnose.diagnosis import searched
from rtid.diagnose.excuse import steady
from rtid.diagnose.fit import Fit
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.residual import effect_values, transformed_like
from rtid.diagnose.standing import fitted, stand
from rtid.diagnose.summary import diagnosis
from rtid.effects.laws import total_softness
from rtid.effects.record_view import RecordView
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.estimator.record import RecordFit, run
from rtid.estimator.solution import solve
from rtid.estimator.state import build, nominal_weights
from rtid.kernels.explain import explain
from rtid.maps.prior_map import of_flow
from rtid.model import Edge, Grid, Machine
from rtid.plain import FloatArray
from rtid.plants import diagnose
from rtid.plants.fitted import PlantModel
from rtid.plants.plant import PlantRecord
from rtid.plants.validation import on_record
from rtid.study.known_effects import acting, learn_acting
from rtid.study.quick_machine import dp_grid

COARSE_V = np.array([1.0, 1.4, 1.8, 2.2, 2.6, 3.2, 4.0, 5.0, 6.5, 8.0, 10.0])
COARSE_PA = 1e6 * np.array([-0.3, 0.0, 0.25, 0.7, 1.5, 2.5, 4.0, 6.0])
JUDGING = 0.75  # share of a record that teaches the diagnosis; the rest judges it


@dataclass(frozen=True)
class Asked:
    """A published map beside its effects; fit: None where there can be none.

    edges: those of the map, where it has another grid than was declared.
    """

    record: RecordFit
    flowmap: FlowMap
    fit: Fit | None = None
    edges: tuple[Edge, ...] = ()

    def predict(self, test: Record) -> FloatArray:
        """dP/dt (n, c), Pa/s, of every interval at its first sample."""
        model, chunk, candidate = test.machine, test.chunk, candidate_of(self.record, self.flowmap)
        softness = np.zeros((len(chunk), len(model.chambers)))
        model = replace(model, edges=self.edges or self.record.solution.model.edges)
        if self.fit is not None:
            acts = acting(self.fit, chunk, self.flowmap)
            softness = _softness(self.fit, chunk)
            terms = np.ones(len(acts.model.terms))
            model, chunk, candidate = acts.model, acts.chunk, replace(candidate, terms=terms)
        lacks = _lacking(model, candidate, chunk)
        for c, chamber in enumerate(model.chambers):
            x = chunk[:, 2 + model.column(model.position)]
            volume = chamber.v0_m3 + chamber.sign * chamber.area_m2 * x
            lacks[:, c] /= volume * candidate.compliance[c] + softness[:, c]
        pressures = [2 + model.column(chamber.pressure) for chamber in model.chambers]
        p = chunk[:, pressures]
        rate = np.diff(p, axis=0, append=p[-1:]) / np.median(np.diff(chunk[:, 0]))
        return np.asarray(rate - lacks)

    def flow(self, edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Q in m3/s."""
        return self.flowmap.flow(edge, w_v, dp_pa)

    def learned(self, missing: Names | None) -> Learned:
        """All of it as an answer."""
        solution = self.record.solution
        return Learned(
            self.predict, self.flow, self.flowmap.sd, solution.beta_pa, solution.beta_sd_pa, missing
        )


def _lacking(model: Machine, candidate: CandidateMap, chunk: FloatArray) -> FloatArray:
    """Measured less modelled flow (n, c), m3/s, of each interval at its first sample.

    Where a point is off the grid, nothing is known: the flow counts as what was measured, zero.
    """
    n, c = len(chunk) - 1, len(model.chambers)
    flow, innovation = np.empty((n, 2 * c)), np.empty((n, c))
    cells = np.empty((n, len(model.edges)), np.int64)
    state = build(model.with_taylor_maps, candidate.weights)
    state.engine[0]["term_theta"][: len(candidate.terms)] = candidate.terms
    theta, compliance = candidate.theta, candidate.compliance
    explain(state.engine, state.cells, theta, compliance, chunk, flow, cells, innovation)
    lacks = flow[:, 0::2] - flow[:, 1::2]
    off = ~np.isfinite(lacks)
    lacks[off] = flow[:, 0::2][off]
    return np.vstack([np.nan_to_num(lacks), np.zeros((1, c))])


def _softness(fit: Fit, chunk: FloatArray) -> FloatArray:
    """What the effects add to V / beta (n, c), m3/Pa."""
    view = RecordView.of(fit.model, transformed_like(fit, chunk), fit.weights, fit.map)
    return np.asarray(total_softness(view, effect_values(fit)))


def beside(fit: Fit, chunk: FloatArray) -> Asked:
    """The published map of a record, chunk (n, 2 + signals), beside the effects of a fit."""
    calm = steady(fit)
    _, record = learn_acting(calm, usable(calm.declared, chunk))
    return Asked(record, publish(record.solution), calm)


def on_its_grid(record: Record) -> Machine:
    """The declared machine with the drops that the record has, as `rtid quick` lays its grids.

    The declared commands stay, up to a largest one that the sensor has rounded up.
    """
    machine, edges = record.machine, []
    for edge in record.machine.edges:
        w = edge.direction * record.column(edge.command)
        dp = (record.column(edge.source) - record.column(edge.sink))[w > edge.safe_band_v]
        u = np.append(edge.grid.u_v[:-1], max(edge.grid.u_v[-1], 1.001 * w.max()))
        edges.append(replace(edge, grid=Grid(u, dp_grid(dp.min(), dp.max()))))
    return replace(machine, edges=tuple(edges))


class RtidMap:
    """What `rtid replay` learns: no diagnosis, nothing is added."""

    def name(self) -> str:
        """Its row."""
        return "rtid, map alone"

    def learn(self, train: Record) -> Learned:
        """The map on a grid of the record."""
        chunk = train.chunk
        return beside(fitted(on_its_grid(train), chunk), chunk).learned(None)


class Rtid:
    """`rtid diagnose` on three quarters of the record, and the map with what it found on all."""

    says_names = True

    def name(self) -> str:
        """Its row."""
        return "rtid"

    def learn(self, train: Record) -> Learned:
        """The map, the effects, and their names."""
        try:
            model, chunk = on_its_grid(train), train.chunk
        except NotForThisError:
            return _equations(train)
        taught = round(JUDGING * len(chunk))
        result = searched(stand(model, chunk[:taught], chunk[taught:]))
        return beside(result.last, chunk).learned(names_of(diagnosis(result)))


def names_of(said: Diagnosis) -> Names:
    """Its sets of names; what is there and has no name is UNKNOWN."""
    if not said.found:
        return UNKNOWN if said.verdict == "unknown" else NOTHING
    sets = ({e.effect, *(name.split(" ")[0] for name in e.cannot_be_told_from)} for e in said.found)
    return tuple(frozenset(names) for names in sets)


class PlainRls:
    """The paper's recursion: Taylor blocks on rows behind its filter, nothing whitened.

    On rtid's fine grid its blocks are not excited enough and explode: it gets a grid of the paper's
    size, and the data sheet's map as its prior.
    """

    def name(self) -> str:
        """Its row."""
        return "block RLS (carry)"

    def learn(self, train: Record) -> Learned:
        """Recursive least squares over the record as it came."""
        top = max(8e6, float(train.machine.edges[0].grid.dp_pa[-1]))
        grid = Grid(COARSE_V, np.append(COARSE_PA, top))
        edges = tuple(replace(e, grid=grid) for e in train.machine.edges)
        model = replace(train.machine, form="carry", edges=edges)
        weights = nominal_weights(model)
        solution = solve(model, run(model, train.chunk, weights))
        record = RecordFit(solution, weights, 0.0, np.zeros(0), np.zeros(0))
        flowmap = publish(solution, of_flow(model, sheet_flow(train)))
        return Asked(record, flowmap, edges=edges).learned(None)


def _equations(train: Record) -> Learned:
    """`rtid refit --diagnose`: output error, and the effects of a plant by equations."""
    plant = train.plant_file.plant
    n = len(plant.inputs)
    record = PlantRecord(train.t_s, train.values[:, :n], train.values[:, n:])
    said = diagnose(plant, record)
    named = tuple(frozenset({f.key[0], *(e for e, _ in f.alike)}) for f in said.found)
    model: PlantModel = said.last
    if not named and said.verdict == "unknown":
        named = UNKNOWN
    return Learned(lambda test: free_run_of(model, test), missing=named)


def free_run_of(model: PlantModel, test: Record) -> FloatArray:
    """Outputs (n, p) of the free run on other inputs."""
    n = len(model.base.inputs)
    still = np.zeros((len(test.t_s), len(model.base.outputs)))
    record = PlantRecord(test.t_s, test.values[:, :n], still)
    return np.asarray(still - on_record(model.fit, record, same_start=True))


METHODS = (RtidMap(), Rtid(), PlainRls())
