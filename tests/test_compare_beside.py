"""Effects of a project count in compare, replay and export: terms, told unknowns, the whole way."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import typer

from rtid.cli.compare import compare
from rtid.cli.export import export
from rtid.cli.replay import replay as replay_command
from rtid.compare import FREE_RUN
from rtid.diagnose.diagnosis import searched
from rtid.diagnose.excuse import steady
from rtid.diagnose.fit import fit, prepare
from rtid.diagnose.revision import Revision
from rtid.diagnose.standing import stand
from rtid.effects.column import Candidate
from rtid.effects.law import chambers_by_place
from rtid.effects.laws import causes
from rtid.effects.record_view import RecordView
from rtid.effects.terms import LEAST_PA, MOST_PA, SHIFTS_PA, shares, terms_of
from rtid.estimator.batch import column_rates, term_rates
from rtid.estimator.factor import misfit
from rtid.estimator.flowmap import VALID, FlowMap
from rtid.estimator.published import publish
from rtid.estimator.record import RecordFit, run
from rtid.estimator.solution import solve
from rtid.estimator.state import nominal_weights
from rtid.estimator.sums import Sums
from rtid.estimator.track import follow, stored_per_pressure
from rtid.maps.files import read_map
from rtid.model import Machine, Term
from rtid.plain import FloatArray
from rtid.sim.extra_flows import gap_flow
from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.sensing import P_A, P_B
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.compared import TraceComparison, study
from rtid.study.known_effects import acting, learn_acting, learn_beside, told
from rtid.study.revisions import add
from rtid.study.study import Study
from rtid.tell.added import sentences
from rtid.tell.charts.points import spread_points
from rtid.units import MPA
from tests.command import output_of
from tests.diagnose.records import record
from tests.estimator.cases import draw_case
from tests.replays import shared_replays  # noqa: F401

SEEN_S, ALL_S = 30.0, 40.0
ATMOSPHERE_PA = 101325.0
LIVE = (  # functions of the signals at one instant: the rest needs a record
    *("internal_leakage_laminar", "internal_leakage_turbulent", "external_leakage_laminar"),
    *("external_leakage_turbulent", "valve_seat_leakage", "relief_valve", "makeup_valve"),
    *("extra_dead_volume", "hose_compliance", "cavitation", "entrained_air"),
)
LEAK, DELAY, RELIEF = "internal_leakage_laminar", "input_delay", "relief_valve"
DRIFT = "valve_gain_drift"
LPM_PER_MPA = 6e10
APP = typer.Typer()
APP.command()(compare)
APP.command()(export)
APP.command("replay")(replay_command)


@cache
def part() -> tuple[Machine, FloatArray]:
    """Half a second of motion, with pressures that are all above zero."""
    model, chunk, _ = record()
    return model, chunk[4000:4500]


def view_of(model: Machine, chunk: FloatArray) -> RecordView:
    low = tuple(replace(s, minimum=1e4) if s.kind == "pressure" else s for s in model.signals)
    return RecordView.without_map(
        replace(model, signals=low), chunk, np.full(2, 1.0 / model.beta_nominal_pa)
    )


def flow_of_terms(view: RecordView, effect: Candidate, value: float) -> FloatArray:
    """Mean flow (n - 1, chambers) of an effect's terms, by the oracle of the recursion."""
    model = replace(view.model, terms=terms_of(view.model, view.compliance, effect, value))
    weights, values = nominal_weights(model), view.chunk[:, 2:]
    track = follow(model, view.t_s, values, view.chunk[:, 1].astype(np.int64), weights)
    rates, _ = column_rates(model, view.t_s, values, track, weights)
    assert len(rates) == view.n - 1
    columns = rates[:, :, :, 3 : 3 + len(model.terms)]
    return np.asarray(columns.mean(axis=2).sum(axis=2))


@pytest.mark.parametrize("name", LIVE)
def test_terms_are_the_columns_of_the_diagnosis(name: str) -> None:
    view = view_of(*part())
    offered = [k for k in causes(view) if k.candidate.effect == name]
    assert offered
    for cause in offered:
        shape = cause.shapes[0]
        if name in ("relief_valve", "makeup_valve", "cavitation"):
            at = chambers_by_place(view.model)[cause.candidate.where]
            shape = (max(float(np.median(view.pressure(c))) for c in at), *shape[1:])
        effect, value = cause.at(shape), 3e-12
        wanted = np.zeros((view.n - 1, 2))
        for c, volume in cause.column(shape).items():
            wanted[:, c] = value * volume / view.dt_s
        found = flow_of_terms(view, effect, value)
        assert np.abs(wanted).max() > 0
        np.testing.assert_allclose(found, wanted, atol=2e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("kappa", [1.0, 1.2, 1.4, 1.6])
def test_air_is_a_sum_of_inverses(kappa: float) -> None:
    p, s = np.geomspace(LEAST_PA, 40e6, 500), 1.0 / kappa
    slope = s / p * (ATMOSPHERE_PA / p) ** s
    at = np.geomspace(LEAST_PA, MOST_PA, 200)
    gains = shares(at, s / at * (ATMOSPHERE_PA / at) ** s)
    found = (gains / (p[:, None] + np.array(SHIFTS_PA)) ** 2).sum(axis=1)
    np.testing.assert_allclose(found, slope, rtol=0.007)


def test_a_poppet_with_a_state_has_no_terms() -> None:
    view = view_of(*part())
    cause = next(k for k in causes(view) if k.candidate.effect == RELIEF)
    assert terms_of(view.model, view.compliance, cause.at((2e6, 0.0, 0.0)), 1e-12)
    assert not terms_of(view.model, view.compliance, cause.at((2e6, 0.02, 0.0)), 1e-12)
    assert not terms_of(view.model, view.compliance, cause.at((2e6, 0.0, 1e5)), 1e-12)
    drift = next(k for k in causes(view) if k.candidate.effect == "valve_gain_drift")
    assert not terms_of(view.model, view.compliance, drift.candidate, 1e-3)


def test_shared_unknowns_are_as_told_and_the_maps_follow() -> None:
    model, chunk, _ = record()
    sums = Sums.of(run(model, chunk[:8000]))
    theta, cov = np.array([1.1, 0.9]), np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    replaced = told(sums, theta, cov)
    found = solve(model, replaced)
    np.testing.assert_allclose(found.unknowns[:2], theta, rtol=1e-6)
    own = found.compliance_cov / np.outer(found.scale_pa, found.scale_pa)
    np.testing.assert_allclose(own, cov, rtol=1e-4)
    normal, prior = sums.normal(), 1e-2
    maps = np.linalg.solve(
        normal.gram[2:, 2:] + prior * np.eye(len(normal.right) - 2),
        normal.right[2:] - normal.gram[2:, :2] @ theta,
    )
    np.testing.assert_allclose(found.unknowns[2:], maps, rtol=1e-5, atol=1e-6)
    left = misfit(sums, found.unknowns)
    assert misfit(replaced, found.unknowns) == pytest.approx(left, rel=1e-6)


def test_an_effect_that_cannot_follow_is_taken_from_the_measured_pressures() -> None:
    """The same leak as a term and as a flow: one equation residual, and who can follow is said."""
    model, chunk, _ = record(LEAK, 2e-12)
    weights = prepare(model, chunk)
    drift = Candidate("valve_gain_drift", "all valves", "relative_change", "1", 1.0, sign=0)
    leak = Candidate(LEAK, "a-b", "coefficient", "m3/s/Pa", 1e-9)
    fitted = fit(model, chunk, weights, Revision((leak, drift)), bank=False)
    machine = acting(fitted, chunk)
    assert machine.measured == (drift,)
    assert [effect.effect for effect in machine.of] == [LEAK, *2 * ["valve_gain_drift"]]
    learned = learn_beside(fitted, machine, machine.chunk)
    terms, leak_value = learned.solution.terms, fitted.held.value(fitted.column(leak))
    np.testing.assert_allclose(terms, [leak_value, 1.0, 1.0], rtol=1e-3)
    np.testing.assert_allclose(learned.solution.compliance, fitted.compliance, rtol=1e-5)


@pytest.mark.long
def test_maps_beside_air_are_weighed_by_what_the_air_makes_of_the_pressures_noise() -> None:
    """At low pressure air makes a chamber thirty times as soft, and the noise as large."""
    model, chunk, held_out = record("entrained_air", 0.06)
    last = searched(stand(model, chunk, held_out)).last
    assert [effect.effect for effect in last.revision.effects] == ["entrained_air"]
    calm = steady(last)
    acts = acting(calm, calm.chunk)
    assert learn_beside(calm, acts, acts.chunk).solution.rho < 2.0 * max(last.rho, 1.0)


def test_what_terms_store_per_pressure_is_the_slope_of_their_columns() -> None:
    model = draw_case(630, terms=6).model
    values = np.array([1.0, 2e6, 3e6, 8e6, 1e5, 0.2])
    soft = stored_per_pressure(model, values, np.zeros(2))
    for c, chamber in enumerate(model.chambers):
        moved = values.copy()
        moved[model.column(chamber.pressure)] += 1.0
        at = np.stack([values, moved])
        flows = (dict(t.signs).get(chamber.name, 0) * stored(model, t, at) for t in model.terms)
        assert soft[c] == pytest.approx(sum(flows), rel=1e-6, abs=1e-22)


def stored(model: Machine, term: Term, values: FloatArray) -> float:
    """What a term of a rate takes up between two samples, m3, with the volume of the first."""
    if not term.rate:
        return 0.0
    taken = term_rates(model, term, values, np.array([1]), np.ones(1))
    return -float(taken[0, 0])


@pytest.mark.long
def test_a_drift_acts_on_blocks_as_well_that_the_fit_had_to_leave_out() -> None:
    """The fit is of a third of the record, the maps are of all of it."""
    model, chunk, _ = record("valve_gain_drift", 0.09)
    third, plant = len(chunk) // 3, draw(3)
    drift = Candidate("valve_gain_drift", "all valves", "relative_change", "1", 1.0, sign=0)
    weights = prepare(model, chunk[:third])
    seen = fit(model, chunk[:third], weights, Revision((drift,)), bank=False)
    acts = acting(seen, chunk)
    once, twice = learn_beside(seen, acts, acts.chunk), learn_acting(seen, chunk)[1]

    def error(learned: RecordFit) -> float:
        """Mean of all valves at the points of the record, of the largest flow."""
        flowmap, shares = publish(learned.solution), []
        for edge in model.edges:
            points = spread_points(model, edge, chunk, 300).T
            true = plant.flow(edge.name, points[0], points[1] / MPA)
            off = flowmap.flow(edge.name, points[0], points[1] / MPA) - true
            shares.append(np.nanmean(np.abs(off)) / np.abs(true).max())
        return float(np.mean(shares))

    assert error(twice) < 0.7 * error(once)


HIDDEN = {"clean": "", "leak": LEAK, "delay": DELAY, "drift": DRIFT}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records of one machine, clean and with an effect each; project files before and after."""
    path = tmp_path_factory.mktemp("beside")
    for name, effect in HIDDEN.items():
        plant = hide_wish(SimulatedPlant(), f"{effect}=middle") if effect else SimulatedPlant()
        write_run(path / f"{name}.parquet", simulate(plant, "rich", 1, ALL_S), 1, "rich")
        project = path / f"{name}.toml"
        parts = f"[record]\nidentification_s = [0, {SEEN_S}]\nvalidation_s = [{SEEN_S}, {ALL_S}]\n"
        project.write_text(project.read_text().partition("[record]")[0] + parts)
        (path / f"{name}_before.toml").write_text(project.read_text())
        if effect:
            add(project, path / f"{name}.parquet", effect)
    return path


@cache
def studied(folder: Path, project: str) -> TraceComparison:
    trace = folder / (project.removesuffix("_before") + ".parquet")
    return study(Study(folder / f"{project}.toml", trace).replay)


def errors(comparison: TraceComparison) -> tuple[float, float]:
    """Held-out: residual as a share of the flow, and rms of the free run in Pa."""
    examined = comparison.held[0].examinations["validation"]
    run = examined.simulations[FREE_RUN]
    return float(np.mean(examined.equation.residual_share)), float(np.mean(run.rms_pa))


def map_error(flowmap: FlowMap) -> float:
    """Rms distance of all valid nodes from the true maps, of the largest flow."""
    plant, off = SimulatedPlant(), []
    for edge in flowmap.edges:
        w, dp = (a.ravel() for a in np.meshgrid(edge.grid.u_v, edge.grid.dp_pa, indexing="ij"))
        valid = edge.status_at(w, dp) == VALID
        away = edge.flow(w, dp) - plant.flow(edge.name, w, dp)
        off.append(away[valid] / edge.q_max_m3s)
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


@pytest.mark.long
@pytest.mark.parametrize("name", ["leak", "delay"])
def test_held_out_errors_fall_to_those_of_the_clean_machine(folder: Path, name: str) -> None:
    clean, before, after = (studied(folder, n) for n in ("clean", f"{name}_before", name))
    (floor, floor_pa), (old, old_pa), (new, new_pa) = errors(clean), errors(before), errors(after)
    assert old > 2.0 * floor and old_pa > 2.0 * floor_pa
    assert new < 1.3 * floor
    assert new_pa < 1.3 * floor_pa
    assert [k.effect for k in after.replay.added] == [HIDDEN[name]]
    assert before.replay.added == ()


@pytest.mark.long
def test_a_drift_acts_on_flows_that_the_fit_has_not_visited(folder: Path) -> None:
    """Its flow is a share of the valves': on unseen motion that of the published map."""
    clean, before, after = (studied(folder, n) for n in ("clean", "drift_before", "drift"))
    assert errors(after)[0] < 0.7 * errors(before)[0]
    assert errors(after)[0] < 1.3 * errors(clean)[0]
    assert [(k.effect, k.follows) for k in after.replay.added] == [(DRIFT, False)]
    assert "taken from the measured pressures" in " ".join(sentences(after.replay.added))


@pytest.mark.long
@pytest.mark.parametrize(("name", "of_clean"), [("leak", 3.0), ("delay", 1.3)])
def test_the_map_and_beta_come_nearer_to_the_truth(
    folder: Path, name: str, of_clean: float
) -> None:
    """The simulated leak widens with pressure, its column does not: 2.4 times the clean error."""
    before, after = studied(folder, f"{name}_before"), studied(folder, name)
    assert map_error(after.flowmap) < 0.6 * map_error(before.flowmap)
    assert map_error(after.flowmap) < of_clean * map_error(studied(folder, "clean").flowmap)
    np.testing.assert_allclose(after.held[0].beta_pa, SimulatedPlant().beta_pa, rtol=0.01)


def test_blocks_are_those_of_the_map_beside_the_effect(folder: Path) -> None:
    before, after = studied(folder, "leak_before"), studied(folder, "leak")
    rms = [
        {(b.edge, b.i, b.j): b.residual_rms_m3s for b in found.blocks if b.status == VALID}
        for found in (before, after)
    ]
    shared = sorted(set(rms[0]) & set(rms[1]))
    assert len(shared) > 30
    assert np.median([rms[1][k] / rms[0][k] for k in shared]) < 0.5


def let_through(p_a: FloatArray, p_b: FloatArray) -> float:
    """The coefficient that the leak's own flow has over pressures (n,), Pa: its gap widens."""
    drop = p_a - p_b
    return float(gap_flow.py_func(2e-12, p_a, p_b) @ drop / (drop @ drop))


@pytest.mark.slow
def test_compare_in_words_and_json(folder: Path, tmp_path: Path) -> None:
    arguments = ("compare", folder / "leak.parquet", "-p", folder / "leak.toml")
    against = ("--against", folder / "leak_before.toml", "--table", tmp_path / "t.csv")
    text = " ".join(output_of(APP, *arguments, *against).split())
    assert "explains the validation part better than" in text
    found = json.loads(output_of(APP, *arguments, "--json"))
    (known,) = found["added"]
    assert (known["effect"], known["where"], known["follows"]) == (LEAK, "a-b", True)
    size = known["parameters"]["coefficient"]["value"]
    taught = Study(folder / "leak.toml", folder / "leak.parquet").taught
    assert size == pytest.approx(let_through(taught[:, 2 + P_A], taught[:, 2 + P_B]), rel=0.02)
    said = re.search(r"The model has Internal leakage, laminar at a-b: coefficient (\S+) ±", text)
    assert said and float(said[1]) == pytest.approx(LPM_PER_MPA * size, rel=1e-3)
    assert (tmp_path / "t.csv").stat().st_size > 0


@pytest.mark.slow
def test_replay_learns_beside_and_keeps_the_boards_memory(folder: Path, tmp_path: Path) -> None:
    told_ = json.loads(
        output_of(APP, "replay", folder / "delay.parquet", "-p", folder / "delay.toml", "--json",
            "--snapshot", tmp_path / "memory.npz",
        )
    )  # fmt: skip
    assert told_["added"][0]["parameters"]["delay"]["value"] == pytest.approx(5e-3, abs=1e-4)
    assert told_["lag_s"] == pytest.approx(1.3e-3, abs=3e-4)
    text = output_of(
        APP, "export", tmp_path / "memory.npz", tmp_path / "m.json", "-p", folder / "delay.toml"
    )
    assert "This snapshot was learned without input_delay at command" in " ".join(text.split())
    assert read_map(tmp_path / "m.json")[1]["effects"] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "suffix", [".json", *(pytest.param(k, marks=pytest.mark.long) for k in (".npz", ".csv"))]
)
def test_the_exported_map_names_its_effects(folder: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    text = output_of(APP, "export", folder / "leak.parquet", path, "-p", folder / "leak.toml")
    assert f"Learned beside {LEAK} at a-b" in text
    if suffix == ".csv":
        with path.open() as file:
            origin = json.loads(next(csv.reader(file, delimiter="\n"))[0].split(" ", 2)[2])
    else:
        flowmap, origin = read_map(path)
        assert map_error(flowmap) < 0.6 * map_error(studied(folder, "leak_before").flowmap)
    assert [(e["effect"], e["where"]) for e in origin["effects"]] == [(LEAK, "a-b")]
