"""Hidden flows and storage of the simulated machine obey their stated laws, with their sizes."""

import numpy as np
import pytest

from rtid.sim import extra_flows, loop, sensing, spool
from rtid.sim.extra import NONE, RECORD, Extra, as_record
from rtid.sim.hidden import HIDDEN, LEVELS, HiddenError, hide
from rtid.sim.plant import Constants, FloatArray, Plant
from rtid.sim.random_plants import draw, draw_hidden
from rtid.sim.run import EXACT, Run, simulate

P_A, P_B = 1, 2
PLAIN_FIGURES = [-7.792782482642862, 4217517.620223735, 5176918.3507615235, 0.22421678917025525]


def rich(plant: Plant, duration_s: float = 6.0, substeps: int = 10) -> Run:
    return simulate(plant, "rich", 3, duration_s, EXACT, substeps)


def still(plant: Plant, duration_s: float = 1.0) -> Run:
    return simulate(plant, "standstill", 3, duration_s, EXACT)


def hidden(name: str, level: str = "middle", where: str = "") -> Plant:
    return hide(Plant(), name, HIDDEN[name].strength(level), where)


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
    assert hide(Plant(), name, 0.0) == Plant()


def test_extra_kernels_without_extra_are_the_plain_machine() -> None:
    """An effect that cannot act runs the extra kernels and changes nothing but round-off."""
    idle = Plant(extra=Extra(relief=(1e-30, 0.0), relief_open_pa=(1e9, 0.0)))
    plain, same = rich(Plant(), 3.0).truth, rich(idle, 3.0).truth
    assert np.allclose(plain.signals, same.signals, rtol=1e-9, atol=1e-12)
    assert np.allclose(plain.flow_m3s, same.flow_m3s, rtol=1e-8, atol=1e-15)


def test_the_plain_machine_has_not_changed() -> None:
    """Figures of the machine from before it could hide anything."""
    s = simulate(draw(3), "rich", 3, 5.0).truth.signals[-1]
    assert s[[0, 1, 2, 5]] == pytest.approx(PLAIN_FIGURES, rel=1e-9)


@pytest.mark.parametrize("name", HIDDEN)
def test_the_step_is_fine_enough(name: str) -> None:
    """Twice the substeps change pressures by less than 1e-4 of them."""
    plant = hidden(name, "strong")
    coarse, fine = (rich(plant, 2.0, n).truth.signals[:, 1:3] for n in (12, 24))
    assert np.abs(coarse / fine - 1).max() < 1e-4


@pytest.mark.parametrize("name", HIDDEN)
def test_effects_are_felt_and_grow(name: str) -> None:
    """Each strength moves what is measured, more than the weaker one."""
    plain = rich(Plant()).samples.values
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
    assert q[shut] / np.sqrt(drop[shut]) == pytest.approx(9e-9, rel=0.02)
    plain = run.plant.flow("bt", w[far], drop[far])
    assert np.abs(q[far] / plain - 1).max() < 0.02
    others = run.truth.flow("at")[run.truth.opening_v[:, 1] < 1.0]
    assert not others.any()


@pytest.mark.parametrize(
    ("name", "where"),
    [
        ("internal_leakage_laminar", ""),
        ("external_leakage_laminar", "b"),
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
    assert name == "valve_seat_leakage" or balance(without).max() > 2e-3


def test_dead_volume_stores_oil() -> None:
    """The balance closes with V_dead / beta at the chamber told, and not without."""
    run = rich(hidden("extra_dead_volume", "strong", "a"))
    more = np.array([1.2e-3 / run.plant.beta_pa, 0.0])[:, None]
    assert balance(run, more).max() < 5e-4  # 2 ms behind: not exactly
    assert balance(run)[0] > 1.5e-3


def test_air_softens_the_oil_at_low_pressure() -> None:
    """1 / beta of the mixture is that of oil plus the stated share of isothermal air at 1.5 MPa."""
    c = Constants()
    e = as_record(hidden("entrained_air").extra)
    at = [extra_flows.compressibility(c, e, 0, p) - 1 / c.beta_pa for p in (0.5e6, 1.5e6, 6e6)]
    assert at[1] == pytest.approx(0.03 * 101325 / 1.5e6**2, rel=0.03)
    assert at[0] > 7 * at[1] and at[2] < at[1] / 12
    run = rich(hidden("entrained_air", "strong"))
    e = as_record(run.plant.extra)
    p, x = run.truth.signals[:, 1:3], run.truth.signals[:, 5]
    volumes = (c.v0_a_m3 + c.area_a_m2 * x, c.v0_b_m3 + c.area_b_m2 * (c.stroke_m - x))
    more = np.array(
        [
            [v * (extra_flows.compressibility(c, e, i, at) - 1 / c.beta_pa) for v, at in rows]
            for i, rows in enumerate(zip(volumes[j], p[:, j], strict=True) for j in range(2))
        ]
    )
    assert balance(run, more).max() < 5e-4


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


def test_supply_sags_with_the_flow_and_the_column_does_not_show_it() -> None:
    run = simulate(hidden("supply_sag", "strong"), "sweep", 1, 10.0, EXACT)
    p_s, drawn = run.truth.signals[:, 3], run.truth.flow("pa") + run.truth.flow("pb")
    assert p_s.min() < 6.5e6
    assert (7e6 - p_s).mean() == pytest.approx(3.3e9 * drawn.mean(), rel=0.1)
    assert (run.samples.column("p_supply") == 7e6).all()


def test_gain_drift_warms_up_by_its_strength() -> None:
    run = rich(hidden("valve_gain_drift", "strong"), 20.0)
    w, s = run.truth.opening_v[:, 0], run.truth.signals
    open_ = w > 3.0
    factor = run.truth.flow("pa")[open_] / run.plant.flow(
        "pa", w[open_], (s[:, 3] - s[:, 1])[open_]
    )
    t = np.arange(len(s))[open_] / len(s)
    assert factor == pytest.approx(1 + 0.09 * np.expm1(-2 * t) / np.expm1(-2), rel=1e-4)
    linear = np.polyfit(t, factor, 1)[0]
    assert linear == pytest.approx(0.09, rel=0.1)


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
        hide(Plant(), name, strength, where)
    assert caught.value.remedy


def test_an_effect_is_hidden_once_in_a_place() -> None:
    twice = hide(hidden("relief_valve", where="a"), "relief_valve", 1e-12, "b")
    with pytest.raises(HiddenError, match="twice"):
        hide(twice, "relief_valve", 1e-12, "a")


def test_random_machines_hide_a_varied_strength_in_a_varied_place() -> None:
    found = [draw_hidden(seed, "relief_valve", "strong").hidden[0] for seed in range(12)]
    assert {h.where for h in found} == {"a", "b"}
    shares = [h.strength / 27e-12 for h in found]
    assert 0.7 <= min(shares) < 0.9 and 1.1 < max(shares) <= 1.3
    bare = draw_hidden(3, "input_delay", "weak")
    assert (bare.constants, bare.valves) == (draw(3).constants, draw(3).valves)
    assert bare == draw_hidden(3, "input_delay", "weak")


def test_kernels_agree_with_their_python_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that hides everything, six samples, every kernel as plain Python."""
    plant = Plant()
    for name, effect in HIDDEN.items():
        plant = hide(plant, name, effect.strengths[0])
    compiled = simulate(plant, "rich", 2, 0.006)
    for module in (loop, extra_flows, spool, sensing):
        for name, kernel in list(vars(module).items()):
            if hasattr(kernel, "py_func"):
                monkeypatch.setattr(module, name, kernel.py_func)
    monkeypatch.setattr("rtid.sim.run.run_loop", loop.run_loop)
    plain = simulate(plant, "rich", 2, 0.006)
    assert np.allclose(plain.samples.values, compiled.samples.values, rtol=1e-12, atol=1e-12)
    assert np.allclose(plain.truth.extra_m3s, compiled.truth.extra_m3s, rtol=1e-9, atol=1e-18)


def test_the_record_holds_every_number() -> None:
    assert RECORD.names == Extra._fields
    assert as_record(NONE) is None
    e = as_record(Extra(relief=(1.0, 2.0), delay_s=3.0))
    assert e is not None and list(e["relief"]) == [1.0, 2.0] and e["delay_s"] == 3.0
