"""Hidden flows and storage of the simulated machine obey their stated laws, with their sizes."""

import numpy as np
import pytest

from rtid.plain import FloatArray
from rtid.sim import closed_loop, dynamics, extra_flows, sensing, spool
from rtid.sim import extra_physics as numbers
from rtid.sim.extra_physics import NONE, Extra, Parts, parts_of
from rtid.sim.hidden import HIDDEN, LEVELS, MECHANICAL, OUTSIDE, HiddenError, hide
from rtid.sim.random_plants import draw, draw_hidden
from rtid.sim.run import EXACT, Run, simulate
from rtid.sim.simulated_plant import EDGES, SimulatedPlant

P_A, P_B = 1, 2
PLAIN_FIGURES = [-7.792782482642862, 4217517.620223735, 5176918.3507615235, 0.22421678917025525]


def rich(plant: SimulatedPlant, duration_s: float = 6.0, substeps: int = 10) -> Run:
    return simulate(plant, "rich", 3, duration_s, EXACT, substeps)


def still(plant: SimulatedPlant, duration_s: float = 1.0) -> Run:
    return simulate(plant, "standstill", 3, duration_s, EXACT)


def hidden(name: str, level: str = "middle", where: str = "") -> SimulatedPlant:
    return hide(SimulatedPlant(), name, HIDDEN[name].strength(level), where)


def balance(run: Run, more: FloatArray | float = 0.0) -> FloatArray:
    """What is missing in the mass balance of A and B, as a share of what moved, float64 (2,).

    more: volume per pascal that a chamber stores besides V / beta, (2, n).
    """
    c, s = run.plant.constants, run.truth.signals
    pa, at, pb, bt, ab = run.truth.flow_m3s.T
    x, missing = s[:, 5], []
    volumes = (c.v0_a_m3 + c.area_a_m2 * x, c.v0_b_m3 + c.area_b_m2 * (c.stroke_m - x))
    signed = (c.area_a_m2, -c.area_b_m2)
    more = np.broadcast_to(more, (2, len(x)))
    for i, q in enumerate((pa - at - ab, pb - bt + ab)):
        came_in = np.trapezoid(q + run.truth.extra_m3s[:, i], dx=1e-3)
        stored = np.trapezoid(volumes[i] / c.beta_pa + more[i], s[:, P_A + i])
        moved = np.trapezoid(np.abs(q), dx=1e-3)
        missing.append((came_in - stored - signed[i] * (x[-1] - x[0])) / moved)
    return np.abs(missing)


@pytest.mark.parametrize("name", HIDDEN)
def test_strength_zero_is_the_plain_machine(name: str) -> None:
    assert hide(SimulatedPlant(), name, 0.0) == SimulatedPlant()


def test_extra_kernels_without_extra_are_the_plain_machine() -> None:
    """An effect that cannot act runs the extra kernels and changes nothing but round-off."""
    idle = SimulatedPlant(extra=Extra(relief=(1e-30, 0.0), relief_open_pa=(1e9, 0.0)))
    plain, same = rich(SimulatedPlant(), 3.0).truth, rich(idle, 3.0).truth
    assert np.allclose(plain.signals, same.signals, rtol=1e-9, atol=1e-12)
    assert np.allclose(plain.flow_m3s, same.flow_m3s, rtol=1e-8, atol=1e-15)


def test_the_plain_machine_has_not_changed() -> None:
    """Figures of the machine from before it could hide anything."""
    s = simulate(draw(3), "rich", 3, 5.0).truth.signals[-1]
    assert s[[0, 1, 2, 5]] == pytest.approx(PLAIN_FIGURES, rel=1e-9)


@pytest.mark.first_of(9)
@pytest.mark.parametrize("name", HIDDEN)
def test_the_step_is_fine_enough(name: str) -> None:
    """Twice the substeps change pressures by less than 1e-4 of them."""
    plant = hidden(name, "strong")
    coarse, fine = (rich(plant, 2.0, n).truth.signals[:, 1:3] for n in (12, 24))
    assert np.abs(coarse / fine - 1).max() < 1e-4


@pytest.mark.first_of(9)
@pytest.mark.parametrize("name", HIDDEN)
def test_effects_are_felt_and_grow(name: str) -> None:
    """Each strength moves what is measured, more than the weaker one."""
    plain = rich(SimulatedPlant()).samples.values
    felt = [np.abs(rich(hidden(name, k)).samples.values - plain).sum(axis=0) for k in LEVELS]
    columns = felt[0] > 0
    assert columns.any()
    assert (felt[2][columns] > felt[1][columns]).any()
    assert (felt[1][columns] > felt[0][columns]).any()


def test_internal_leak_at_rest_is_coefficient_times_drop() -> None:
    run = still(hidden("internal_leakage_laminar"), 0.05)
    s, extra = run.truth.signals, run.truth.extra_m3s
    drop, mean = s[:, P_A] - s[:, P_B], 0.5 * (s[:, P_A] + s[:, P_B])
    widened = 1 + (mean - 3e6) / 20e6
    assert np.allclose(-extra[:, 0], 2e-12 * drop * widened, rtol=1e-12)
    assert np.array_equal(extra[:, 0], -extra[:, 1])
    assert np.abs(widened - 1).max() < 0.1  # the plain coefficient holds within 10 %


@pytest.mark.parametrize(("where", "column", "sign"), [("a", 0, -1), ("b", 1, 1)])
def test_an_external_leak_empties_its_chamber(where: str, column: int, sign: int) -> None:
    run = still(hidden("external_leakage_laminar", "strong", where), 0.5)
    s, extra = run.truth.signals, run.truth.extra_m3s
    leak = -extra[:, column] / (s[:, P_A + column] - s[:, 4])
    assert leak == pytest.approx(3e-12, rel=0.1)
    assert not extra[:, 1 - column].any()
    assert s[-1, P_A + column] < s[0, P_A + column]
    assert sign * (s[-1, 5] - s[0, 5]) > 0  # the piston gives way towards the leak


def test_a_seat_leaks_when_shut_and_vanishes_when_open() -> None:
    run = rich(hidden("valve_seat_leakage", "strong", "bt"))
    s, w, q = run.truth.signals, run.truth.opening_v[:, 3], run.truth.flow("bt")
    drop = s[:, 2] - s[:, 4]
    shut, far = (w < 1.0) & (drop > 0.5e6), w > 3.5
    assert q[shut] / np.sqrt(drop[shut]) == pytest.approx(4.5e-9, rel=0.02)
    plain = run.plant.flow("bt", w[far], drop[far])
    assert np.abs(q[far] / plain - 1).max() < 0.02
    others = run.truth.flow("at")[run.truth.opening_v[:, 1] < 1.0]
    assert not others.any()


@pytest.mark.parametrize(
    ("name", "where"),
    [
        ("internal_leakage_laminar", ""),
        ("external_leakage_laminar", "b"),
        ("internal_leakage_turbulent", ""),
        ("external_leakage_turbulent", "a"),
        ("position_dependent_leakage", ""),
        ("groove_one_way", ""),
        ("flow_bursts", ""),
        ("makeup_valve", "a"),
        ("relief_valve", "a"),
        ("relief_valve", "b"),
        ("valve_seat_leakage", "pa"),
    ],
)
def test_mass_balance_closes_with_leaks(name: str, where: str) -> None:
    run = rich(hidden(name, "strong", where))
    assert balance(run).max() < 3e-4
    without = Run(run.plant, run.sensors, run.samples, run.truth)
    without.truth.extra_m3s[:] = 0.0
    assert name == "valve_seat_leakage" or balance(without).max() > 1e-3


def test_dead_volume_stores_oil() -> None:
    """The balance closes with V_dead / beta at the chamber told, and not without."""
    run = rich(hidden("extra_dead_volume", "strong", "a"))
    more = np.array([1.2e-3 / run.plant.beta_pa, 0.0])[:, None]
    assert balance(run, more).max() < 5e-4  # 2 ms behind: not exactly
    assert balance(run)[0] > 1.5e-3


def parts(plant: SimulatedPlant) -> Parts:
    found = parts_of(plant.extra)
    assert found is not None
    return found


def softness(plant: SimulatedPlant, p_pa: FloatArray, chamber: int = 0) -> FloatArray:
    """1 / beta_c - 1 / beta at the pressures, 1/Pa."""
    c, e = plant.constants, parts(plant)
    r = (e.a, e.b)[chamber]
    found = [extra_flows.compressibility(c, e, r, p) - 1 / c.beta_pa for p in p_pa]
    return np.array(found)


def volumes(run: Run) -> FloatArray:
    """Volumes of A and B, m3, float64 (2, n)."""
    c, x = run.plant.constants, run.truth.signals[:, 5]
    volume_b = c.v0_b_m3 + c.area_b_m2 * (c.stroke_m - x)
    return np.array([c.v0_a_m3 + c.area_a_m2 * x, volume_b])


def softer(run: Run) -> FloatArray:
    """What both chambers store per pascal besides V / beta, m3/Pa, float64 (2, n)."""
    p = run.truth.signals[:, 1:3].T
    return volumes(run) * np.array([softness(run.plant, p[i], i) for i in range(2)])


def test_air_softens_the_oil_at_low_pressure() -> None:
    """1 / beta of the mixture is that of oil plus the stated share of isothermal air at 2.2 MPa."""
    at = softness(hidden("entrained_air"), np.array([0.8e6, 2.2e6, 6e6]))
    assert at[1] == pytest.approx(0.03 * 101325 / 2.2e6**2, rel=0.04)
    assert at[0] > 6 * at[1] and at[2] < at[1] / 6
    run = rich(hidden("entrained_air", "strong"))
    assert balance(run, softer(run)).max() < 3e-4
    assert balance(run).max() > 1.5e-3


def test_gas_boils_out_below_its_pressure_alone() -> None:
    plant = hidden("cavitation", "strong", "b")
    limit = plant.extra.release_pa[1]
    at = softness(plant, np.array([0.5 * limit, 0.99 * limit, 1.01 * limit]), 1)
    assert at[0] == pytest.approx(13e-3 / limit) and 0 < at[1] < 0.03 * at[0]
    assert at[2] == 0
    assert not softness(plant, np.array([0.5 * limit]), 0).any()
    run = rich(plant)
    assert balance(run, softer(run)).max() < 5e-4


def test_a_hose_wall_stores_oil_and_stiffens() -> None:
    run = rich(hidden("hose_compliance", "strong", "a"))
    wall = 1.5e-12 / (1 + (run.truth.signals[:, P_A] - 4e6) / 8e6)
    assert balance(run, np.array([wall, 0 * wall])).max() < 5e-4
    assert balance(run)[0] > 1.5e-3


def test_relief_valve_opens_at_its_pressure_with_its_slope() -> None:
    run = rich(hidden("relief_valve", "strong"), 20.0)
    opening = run.plant.extra.relief_open_pa[0]
    p, leak = run.truth.signals[:, P_A], -run.truth.extra_m3s[:, 0]
    above = p > opening + 0.5e6
    assert above.mean() > 0.05
    assert leak[above] == pytest.approx(27e-12 * (p[above] - opening), rel=0.03)
    assert leak[p < opening - 0.5e6].max() < 0.02 * leak.max()


def test_a_line_swings_at_its_own_frequency() -> None:
    """Port against chamber: pressures differ by inertance times the change of flow; it rings."""
    run = rich(hidden("line_dynamics", "strong", "a"), 4.0)
    ports, p = run.truth.ports_pa, run.truth.signals[:, 1:3]
    assert np.array_equal(ports[:, 1], p[:, 1])
    drop, c = ports[:, 0] - p[:, 0], run.plant.constants
    volume = c.v0_a_m3 + c.area_a_m2 * run.truth.signals[:, 5]
    into = volume / c.beta_pa * np.gradient(p[:, 0], 1e-3) + c.area_a_m2 * run.truth.signals[:, 6]
    slope = np.polyfit(np.gradient(into, 1e-3), drop, 1)[0]
    assert slope == pytest.approx(7e7, rel=0.1)


def test_make_up_valve_fills_below_its_pressure() -> None:
    run = rich(hidden("makeup_valve", "strong", "b"), 20.0)
    opening = run.plant.extra.makeup_open_pa[1]
    p, into = run.truth.signals[:, P_B], run.truth.extra_m3s[:, 1]
    below = p < opening - 0.3e6
    assert below.mean() > 0.02
    assert into[below] == pytest.approx(27e-12 * (opening - p[below]), rel=0.08)
    assert into.min() >= 0 and into[p > opening + 0.5e6].max() < 0.05 * into.max()


@pytest.mark.parametrize(
    ("name", "column", "sign"),
    [("internal_leakage_turbulent", 0, -1), ("external_leakage_turbulent", 0, -1)],
)
def test_turbulent_leaks_follow_the_root_of_their_drop(name: str, column: int, sign: int) -> None:
    run = rich(hidden(name, "strong"))
    s = run.truth.signals
    drop = s[:, P_A] - (s[:, P_B] if name.startswith("internal") else s[:, 4])
    far = np.abs(drop) > 0.5e6
    found = run.truth.extra_m3s[far, column] / (np.sign(drop) * np.sqrt(np.abs(drop)))[far]
    assert found == pytest.approx(sign * HIDDEN[name].strengths[2], rel=0.03)


def test_a_groove_leaks_in_its_place_and_a_lip_in_its_direction() -> None:
    for name in ("position_dependent_leakage", "groove_one_way"):
        run = rich(hidden(name, "strong"), 20.0)
        s, q = run.truth.signals, run.truth.extra_m3s[:, 1]
        drop, x, v = s[:, P_A] - s[:, P_B], s[:, 5], s[:, 6]
        k, away = q / drop, np.abs(x - 0.26) > 0.07
        top = (np.abs(x - 0.26) < 2e-3) & (v > 0.03)
        assert k[top] == pytest.approx(HIDDEN[name].strengths[2], rel=0.12)
        assert np.abs(k[away]).max() < 0.01 * k.max()
        back = (np.abs(x - 0.26) < 2e-3) & (v < -0.03)
        assert (k[back].max() < 0.01 * k.max()) == (name == "groove_one_way")


def test_bursts_come_by_chance_and_from_the_seed() -> None:
    plant = hidden("flow_bursts", "strong")
    q = simulate(plant, "rich", 3, 30.0, EXACT).truth.extra_m3s
    again, other = (simulate(plant, "rich", i, 30.0, EXACT).truth.extra_m3s for i in (3, 4))
    assert np.array_equal(q, again) and not np.array_equal(q, other)
    assert not q[:, 1].any() and 0.05 < (q[:, 0] != 0).mean() < 0.3
    assert 18e-6 < np.abs(q).max() < 4 * 18e-6 and q.min() < 0 < q.max()


def test_supply_sags_with_the_flow_and_the_column_does_not_show_it() -> None:
    run = simulate(hidden("supply_sag", "strong"), "sweep", 1, 10.0, EXACT)
    p_s, drawn = run.truth.signals[:, 3], run.truth.flow("pa") + run.truth.flow("pb")
    assert p_s.min() < 6.5e6
    assert (7e6 - p_s).mean() == pytest.approx(3.3e9 * drawn.mean(), rel=0.1)
    assert (run.samples.column("p_supply") == 7e6).all()
    seen = simulate(hidden("supply_sag_measured", "strong"), "sweep", 1, 10.0, EXACT)
    assert np.array_equal(seen.truth.signals, run.truth.signals)
    assert np.array_equal(seen.samples.column("p_supply"), p_s)


def test_a_supply_branch_swings_at_9_hz() -> None:
    """The other edge's flow does not see it: its own law holds with the supply's pressure."""
    run = rich(hidden("supply_branch_resonance", "strong"), 20.0)
    s, w = run.truth.signals, run.truth.opening_v
    open_a, open_b = w[:, 0] > 2.5, w[:, 2] > 2.5
    law = run.plant.flow("pb", w[open_b, 2], (s[:, 3] - s[:, 2])[open_b])
    assert run.truth.flow("pb")[open_b] == pytest.approx(law, rel=1e-9)
    law = run.plant.flow("pa", w[open_a, 0], (s[:, 3] - s[:, 1])[open_a])
    ratio = run.truth.flow("pa")[open_a] / law
    assert ratio.std() > 0.005


def test_gain_drift_warms_up_by_its_strength() -> None:
    run = rich(hidden("valve_gain_drift", "strong"), 20.0)
    w, s = run.truth.opening_v[:, 0], run.truth.signals
    open_ = w > 3.0
    factor = run.truth.flow("pa")[open_] / run.plant.flow(
        "pa", w[open_], (s[:, 3] - s[:, 1])[open_]
    )
    t = np.arange(len(s))[open_] / len(s)
    assert factor == pytest.approx(1 + 0.09 * np.expm1(-t / 1.5) / np.expm1(-1 / 1.5), rel=1e-4)
    linear = np.polyfit(t, factor, 1)[0]
    assert linear == pytest.approx(0.09, rel=0.1)


def test_the_gain_swings_with_7_s() -> None:
    run = rich(hidden("gain_oscillation", "strong"), 15.0)
    w, s = run.truth.opening_v[:, 0], run.truth.signals
    open_ = w > 3.0
    plain = run.plant.flow("pa", w[open_], (s[:, 3] - s[:, 1])[open_])
    t = 1e-3 * np.arange(len(s))[open_]
    expected = 1 + 0.09 * np.sin(2 * np.pi * t / 7.0)
    assert run.truth.flow("pa")[open_] / plain == pytest.approx(expected, rel=1e-4)


def test_a_compensated_edge_is_flat_in_the_drop() -> None:
    run = rich(hidden("load_compensated_valve", "strong", "at"), 20.0)
    s, w = run.truth.signals, run.truth.opening_v[:, 1]
    drop = s[:, P_A] - s[:, 4]
    open_ = (w > 2.5) & (drop > 1e6)
    at_2_mpa = run.plant.flow("at", w[open_], 2e6)
    share = run.truth.flow("at")[open_] / at_2_mpa
    assert share == pytest.approx(0.9 + 0.1 * np.sqrt(drop[open_] / 2e6), rel=1e-3)
    b = run.plant.flow("bt", run.truth.opening_v[:, 3], s[:, P_B] - s[:, 4])
    assert np.allclose(run.truth.flow("bt"), b, rtol=1e-9, atol=0)


@pytest.mark.parametrize("name", MECHANICAL[:3])
def test_mechanical_changes_keep_the_pressure_equations(name: str) -> None:
    run = rich(hidden(name, "strong"))
    assert run.plant.extra == NONE and run.plant.hidden[0].name == name
    assert balance(run).max() < 3e-4


def test_groups() -> None:
    assert len(OUTSIDE) >= 4
    silent = {name for name, effect in HIDDEN.items() if not effect.catalogue}
    assert silent == {*OUTSIDE, *MECHANICAL}
    assert HIDDEN["line_dynamics_seen_at_valve"].catalogue == "line_dynamics"


def test_two_effects_at_once() -> None:
    plant = hide(hidden("internal_leakage_laminar"), "input_delay", 5e-3)
    assert [h.name for h in plant.hidden] == ["internal_leakage_laminar", "input_delay"]
    assert plant.extra.internal_laminar == 2e-12 and plant.extra.delay_s == 5e-3
    assert balance(rich(plant)).max() < 3e-4


@pytest.mark.parametrize(
    ("name", "strength", "where", "said"),
    [
        ("leak", 1.0, "", "no such effect"),
        ("relief_valve", 1e-12, "c", "cannot sit at 'c'"),
        ("input_delay", -1.0, "", "strength -1"),
        ("input_delay", float("nan"), "", "strength nan"),
    ],
)
def test_wrong_wishes(name: str, strength: float, where: str, said: str) -> None:
    with pytest.raises(HiddenError, match=said) as caught:
        hide(SimulatedPlant(), name, strength, where)
    assert caught.value.remedy


def test_an_effect_is_hidden_once_in_a_place() -> None:
    twice = hide(hidden("relief_valve", where="a"), "relief_valve", 1e-12, "b")
    with pytest.raises(HiddenError, match="twice"):
        hide(twice, "relief_valve", 1e-12, "a")


@pytest.mark.parametrize(
    ("first", "second", "where"),
    [
        ("spool_lag_second_order", "spool_lag_first_order", ""),
        ("spool_rate_limit", "spool_lag_second_order", ""),
        ("supply_sag", "supply_sag_measured", ""),
        ("extra_dead_volume", "extra_dead_volume", "a"),
        ("line_dynamics", "line_dynamics_seen_at_valve", ""),
    ],
)
def test_no_effect_replaces_another(first: str, second: str, where: str) -> None:
    with pytest.raises(HiddenError, match="another hidden effect"):
        hide(hidden(first), second, 2 * HIDDEN[second].strengths[2], where)


def test_what_has_either_sign() -> None:
    less = rich(hide(SimulatedPlant(), "pressure_sensor_bias", -0.2e6))
    assert (less.samples.values - less.truth.signals)[:, 1] == pytest.approx(-0.2e6)
    signs = {
        np.sign(draw_hidden(i, "valve_gain_drift", "weak").hidden[0].strength) for i in range(9)
    }
    assert signs == {-1, 1}
    assert draw_hidden(1, "input_delay", "weak").hidden[0].strength > 0


def test_random_machines_hide_a_varied_strength_in_a_varied_place() -> None:
    found = [draw_hidden(seed, "relief_valve", "strong").hidden[0] for seed in range(12)]
    assert {h.where for h in found} == {"a", "b"}
    shares = [h.strength / 27e-12 for h in found]
    assert 0.7 <= min(shares) < 0.9 and 1.1 < max(shares) <= 1.3
    bare = draw_hidden(3, "input_delay", "weak")
    assert (bare.constants, bare.valves) == (draw(3).constants, draw(3).valves)
    assert bare == draw_hidden(3, "input_delay", "weak")


SPOOLS = {"spool_lag_first_order", "spool_lag_second_order", "spool_rate_limit"}


@pytest.mark.parametrize("spools", ["spool_lag_second_order", "spool_rate_limit"])
def test_kernels_agree_with_their_python_source(
    spools: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that hides everything, six samples, every kernel as plain Python."""
    plant, others = SimulatedPlant(), {*SPOOLS - {spools}, "line_dynamics", "supply_sag_measured"}
    for name, effect in HIDDEN.items():
        if name not in others:
            plant = hide(plant, name, effect.strengths[0])
    compiled = simulate(plant, "rich", 2, 0.006)
    for module in (dynamics, closed_loop, extra_flows, spool, sensing):
        for name, kernel in list(vars(module).items()):
            if hasattr(kernel, "py_func"):
                monkeypatch.setattr(module, name, kernel.py_func)
    monkeypatch.setattr("rtid.sim.run.run_loop", closed_loop.run_loop)
    plain = simulate(plant, "rich", 2, 0.006)
    assert np.allclose(plain.samples.values, compiled.samples.values, rtol=1e-12, atol=1e-12)
    assert np.allclose(plain.truth.extra_m3s, compiled.truth.extra_m3s, rtol=1e-9, atol=1e-18)


def test_the_kernels_get_every_number() -> None:
    assert numbers.EDGES == EDGES
    names = [*numbers.WHOLE, *numbers.CHAMBER, *numbers.EDGE]
    assert sorted(names) == sorted(Extra._fields)
    assert parts_of(NONE) is None
    e = parts_of(Extra(relief=(1.0, 2.0), delay_s=3.0, seat=(0.0, 0.0, 4.0, 0.0, 0.0)))
    assert e is not None
    assert (e.a.relief, e.b.relief, e.whole.delay_s, e.whole.seat_pb) == (1.0, 2.0, 3.0, 4.0)
