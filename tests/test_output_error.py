"""The output-error refit: exact runs, equations and units of inserted effects, honest intervals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtid.cli.exits import Exit
from rtid.effects import Expression
from rtid.effects.dimension import dimension, dimension_of_unit, unit_of_dimension
from rtid.effects.tree import Node, named, substituted, written
from rtid.plain import FloatArray
from rtid.plants import (
    Input,
    Output,
    Plant,
    PlantError,
    PlantParameter,
    PlantRecord,
    PlantState,
    refit,
)
from rtid.plants.entries import effects_of_plants
from rtid.plants.insertion import everywhere, insert, places, unit_of
from rtid.plants.output_error import fit
from rtid.plants.plant import FIRST_ORDER, ZERO_ORDER
from rtid.plants.simulator import Simulator
from rtid.plants.statistics import memory
from rtid.plants.validation import on_record, rms
from rtid.project.errors import ProjectError
from rtid.project.plant_file import load_plant
from rtid.study.refit import load_records
from tests.command import ends, in_json
from tests.eighty import eighty  # noqa: F401

EXAMPLE = Path(__file__).parents[1] / "rtid" / "project" / "examples" / "cascaded_tanks.toml"


def tree(text: str) -> Node:
    return Expression.parse(text).root


def first_order(hold: str = ZERO_ORDER, **of_input: str) -> Plant:
    """x' = b u - a x."""
    return Plant(
        "lag",
        (PlantState("x", tree("b*u - a*x"), 0.0, -5, 5, "m"),),
        (Input("u", named("u"), hold, "V", **of_input),),
        (Output("y", named("x"), "m"),),
        (PlantParameter("a", 1.0, 0.1, 10, "1/s"), PlantParameter("b", 1.0, 0.1, 10, "m/s/V")),
    )


def run(plant: Plant, t: FloatArray, u: FloatArray, *values: float, sub_steps: int) -> FloatArray:
    record = PlantRecord(t, u[:, None], np.zeros((len(t), len(plant.outputs))))
    return Simulator(plant, record, sub_steps).run(np.array(values)[:, None])[0][:, 0, 0]


def test_free_run_is_exact_in_the_holds() -> None:
    """Against closed forms: held steps, and a ramp that is linear between uneven samples."""
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.05, 0.2, 80)).astype(np.float64)
    u, a, b = rng.standard_normal(80), 2.0, 3.0
    x = np.zeros(80)
    for k in range(79):
        decay = np.exp(-a * (t[k + 1] - t[k]))
        x[k + 1] = decay * x[k] + b / a * u[k] * (1 - decay)
    np.testing.assert_allclose(run(first_order(), t, u, a, b, 0.0, sub_steps=8), x, atol=1e-7)
    ramp = 0.7 * (t - t[0])
    s = t - t[0]
    exact = b * 0.7 * (s / a - (1 - np.exp(-a * s)) / a**2)
    found = run(first_order(FIRST_ORDER), t, ramp, a, b, 0.0, sub_steps=8)
    np.testing.assert_allclose(found, exact, atol=1e-8)


def test_a_gap_in_the_record_is_stepped_through() -> None:
    """The state goes on through a gap of 50 samples, with steps as short as elsewhere."""
    t = np.delete(0.05 * np.arange(200, dtype=np.float64), np.arange(60, 110))
    u = np.where(t < 2.0, 1.0, -1.0)
    found = run(first_order(), t, u, 40.0, 3.0, 0.0, sub_steps=4)
    exact = 3 / 40 * np.where(t < 2.0, 1 - np.exp(-40 * t), -1 + 2 * np.exp(-40 * (t - 2.0)))
    np.testing.assert_allclose(found[t < 2.0], exact[t < 2.0], atol=1e-4)
    np.testing.assert_allclose(found[t > 3.0], exact[t > 3.0], atol=1e-6)


@pytest.mark.parametrize("delay", [0.0, 0.013, 0.1, 0.237])
def test_a_delay_need_not_be_a_whole_number_of_steps(delay: float) -> None:
    """x' = u(t - T) is the delayed integral of the held input, to rounding."""
    plant = Plant(
        "integrator",
        (PlantState("x", named("u"), 0.0, -9, 9),),
        (Input("u", named("u"), delay="T"),),
        (Output("y", named("x")),),
        (PlantParameter("T", 0.1, 0.0, 1.0),),
    )
    rng = np.random.default_rng(2)
    t = 0.1 * np.arange(60, dtype=np.float64)
    u = rng.standard_normal(60)
    total = np.concatenate([[0.0], np.cumsum(0.1 * u[:-1])])
    before = u[0] * np.minimum(t - delay, 0.0)
    exact = np.interp(t - delay, t, total) + before + u[0] * delay
    np.testing.assert_allclose(run(plant, t, u, delay, 0.0, sub_steps=2), exact, atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "x1*2 + u/3 - p**2 + x1**3 - (-x1)**4",
        "sqrt(abs(x1)) + ssqrt(x1) + sign(u)*pos(x1) + abs(u)",
        "exp(-x1) + log(p) + sin(u) + cos(u)*tanh(x1)",
        "min(x1, u) + max(x1, 1.5) + hypot(x1, u) + pi*p**1.5 + 2**x1",
        "7",
        "x1",
    ],
)
def test_instructions_give_what_the_expression_gives(text: str) -> None:
    plant = Plant(
        "any",
        (PlantState("x1", tree("0*x1"), 0.0, -9, 9),),
        (Input("u", named("u")),),
        (Output("y", Expression.parse(text, ["x1", "u", "p"]).root),),
        (PlantParameter("p", 1.0, 0.1, 10),),
    )
    record = PlantRecord(np.arange(3.0), np.full((3, 1), -0.8), np.zeros((3, 1)))
    p, x1 = np.array([0.3, 2.5]), np.array([1.2, -0.4])
    with np.errstate(all="ignore"):
        expected = Expression.parse(text, ["x1", "u", "p"])(x1=x1, u=-0.8, p=p) * np.ones(2)
    found = Simulator(plant, record).run(np.vstack([p, x1]))[0][-1, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def spring() -> Plant:
    """Mass on a spring, driven by a force: SI units, the mass declared."""
    return Plant(
        "spring",
        (
            PlantState("z", named("v"), 0.0, -1, 1, "m", "displacement"),
            PlantState("v", tree("(u - k*z)/m"), 0.0, -1, 1, "m/s", "velocity", named("m")),
        ),
        (Input("u", named("u"), unit="N"),),
        (Output("y", named("z"), "m"),),
        (PlantParameter("k", 20.0, 1, 100, "N/m"), PlantParameter("m", 1.0, 0.1, 10, "kg")),
    )


def store() -> Plant:
    """Two levels in m, and a room; what surrounds the room is an input."""
    return Plant(
        "stores",
        (
            PlantState("h1", tree("q*u - k*ssqrt(h1)"), 1.0, 0, 9, "m", "level"),
            PlantState("h2", tree("k*ssqrt(h1) - k*ssqrt(h2)"), 1.0, 0, 9, "m", "level"),
            PlantState("p", tree("g*u"), 1.0, 0, 9, "Pa", "pressure"),
            PlantState("T", tree("w*u"), 290.0, 0, 400, "K", "temperature", ambient=named("out")),
        ),
        (Input("u", named("u"), unit="V"), Input("out", named("out"), unit="K")),
        (Output("y", named("h2"), "m"),),
        (
            PlantParameter("q", 1.0, 0, 2, "m/s/V"),
            PlantParameter("k", 1.0, 0, 2, "sqrt(m)/s"),
            PlantParameter("g", 1.0, 0, 2, "Pa/s/V"),
            PlantParameter("w", 1.0, 0, 2, "K/s/V"),
        ),
    )


CASES = [(plant, *key) for plant in (spring(), store()) for key in everywhere(plant)]


@pytest.mark.parametrize(("plant", "effect", "where"), CASES, ids=[f"{e}-{w}" for _, e, w in CASES])
def test_inserted_equations_keep_their_units(plant: Plant, effect: str, where: str) -> None:
    inserted = insert(plant, effect, where)
    units = {s.name: s.unit for s in plant.states} | {i.name: i.unit for i in plant.inputs}
    units |= {p.name: p.unit for p in plant.parameters}
    units |= {a.name: unit_of(plant, effect, where, a) for a in inserted.added}
    units |= {s.name: s.unit for s in inserted.plant.states}
    known = {name: dimension_of_unit(unit) for name, unit in units.items()}
    acts = {i.name: i.acts for i in inserted.plant.inputs}
    for state in inserted.plant.states:
        rate = state.rate if state.follows else substituted(state.rate, acts)
        found = dimension(Expression.parse(written(rate)), known)
        assert found is not None
        assert found == dimension_of_unit(f"{state.unit}/s"), (
            f"{state.name}' = {written(rate)} is in {unit_of_dimension(found)}"
        )
    if effect == "backlash":
        assert known[inserted.added[0].name] == dimension_of_unit(plant.outputs[0].unit)


def test_every_entry_is_tried_somewhere() -> None:
    assert {effect for _, effect, _ in CASES} == set(effects_of_plants())


def test_what_overflows_reaches_the_next_tank() -> None:
    found = insert(store(), "overflow", "h1").plant
    spilled = "overflow_h1_rate * pos(h1 - overflow_h1_rim)"
    assert written(found.state("h1").rate) == f"q * u - k * ssqrt(h1) - {spilled}"
    assert written(found.state("h2").rate).endswith(f"+ overflow_h1_into_h2 * ({spilled})")
    assert "overflow" not in written(insert(store(), "overflow", "h2").plant.state("h1").rate)


def test_places_are_physical() -> None:
    assert places(spring(), "coulomb_friction") == ("v",)
    assert places(spring(), "overflow") == () == places(store(), "cubic_stiffness")
    assert places(store(), "heat_loss") == ("T",)
    with pytest.raises(PlantError, match="cannot act at 'z'"):
        insert(spring(), "coulomb_friction", "z")
    with pytest.raises(PlantError, match="entrained_air is no effect of a plant by equations"):
        insert(spring(), "entrained_air", "v")


def lag_record(rng: np.random.Generator, memory_of_noise: float, n: int = 600) -> PlantRecord:
    t = 0.05 * np.arange(n, dtype=np.float64)
    u = np.repeat(rng.standard_normal(n // 20), 20)
    y = run(first_order(), t, u, 1.5, 2.0, 0.0, sub_steps=4)
    noise = np.zeros(n)
    for k in range(1, n):
        noise[k] = memory_of_noise * noise[k - 1] + 0.05 * rng.standard_normal()
    return PlantRecord(t, u[:, None], (y + noise)[:, None])


def test_intervals_hold_under_correlated_errors() -> None:
    """The error of a free run remembers; intervals that ignore it would hold in a third."""
    rng = np.random.default_rng(3)
    inside, naive = [], []
    for _ in range(60):
        found = fit(first_order(), lag_record(rng, 0.9), np.array([[1.0, 1.0, 0.0]]))
        off = abs(found.values - [1.5, 2.0, 0.0])[:2]
        inside.append(off < 1.96 * found.sd[:2])
        flat = found.jacobian[:, 0]
        plain = np.sqrt(np.diag(np.linalg.inv(flat.T @ flat)) * found.rmse[0] ** 2)[:2]
        naive.append(off < 1.96 * plain)
    print(f"inside {np.mean(inside):.3f}, without the correction {np.mean(naive):.3f}")
    assert np.mean(inside) > 0.85
    assert np.mean(naive) < 0.75


def test_memory_of_a_known_process() -> None:
    """AR(1) with coefficient a is worth n (1 - a) / (1 + a) samples."""
    rng = np.random.default_rng(4)
    e = np.zeros(40_000)
    for k in range(1, len(e)):
        e[k] = 0.8 * e[k - 1] + rng.standard_normal()
    assert memory(e)[0] == pytest.approx(9.0, rel=0.2)
    assert memory(rng.standard_normal(40_000))[0] == pytest.approx(1.0, abs=0.1)


def test_what_cannot_be_identified_is_named() -> None:
    """b1 and b2 appear as a product only."""
    plant = Plant(
        "product",
        (PlantState("x", tree("b1*b2*u - a*x"), 0.0, -5, 5),),
        (Input("u", named("u")),),
        (Output("y", named("x")),),
        tuple(PlantParameter(name, 1.0, 0.1, 10) for name in ("a", "b1", "b2")),
    )
    record = lag_record(np.random.default_rng(5), 0.0)
    number, names = refit(plant, record).fit.condition
    assert number > 1e6
    assert set(names) == {"b1", "b2"}
    assert refit(first_order(), record).fit.condition[1] == ()


def test_missing_outputs_are_left_out_and_validation_is_not_fitted() -> None:
    rng = np.random.default_rng(6)
    record, other = lag_record(rng, 0.0), lag_record(rng, 0.0)
    holes = np.where(rng.random((len(record.t_s), 1)) < 0.3, np.nan, record.y)
    found = refit(first_order(), PlantRecord(record.t_s, record.u, holes)).fit
    assert found.samples == int(np.isfinite(holes).sum())
    np.testing.assert_allclose(found.values[:2], [1.5, 2.0], rtol=0.03)
    assert rms(on_record(found, other, same_start=True))[0] == pytest.approx(0.05, rel=0.1)
    assert rms(on_record(found, other, same_start=False))[0] == pytest.approx(0.05, rel=0.1)


def test_records_that_cannot_be_used() -> None:
    t, u = np.arange(5.0), np.zeros((5, 1))
    with pytest.raises(PlantError, match="time does not grow"):
        PlantRecord(t[::-1], u, u)
    with pytest.raises(PlantError, match="missing in row 3"):
        PlantRecord(t, np.where(t[:, None] == 3, np.nan, u), u)
    with pytest.raises(PlantError, match="never measured"):
        PlantRecord(t, u, u * np.nan)
    with pytest.raises(PlantError, match="does not move"):
        refit(first_order(), PlantRecord(t, u, u))


def test_a_plant_that_runs_away_is_refused() -> None:
    plant = Plant(
        "bomb",
        (PlantState("x", tree("a*x**3 + u"), 3.0, 2, 5),),
        (Input("u", named("u")),),
        (Output("y", named("x")),),
        (PlantParameter("a", 5.0, 4.0, 6.0),),
    )
    t = np.arange(50.0)
    with pytest.raises(PlantError, match="leaves every range"):
        refit(plant, PlantRecord(t, t[:, None], np.sin(t)[:, None]))


def test_problems_of_a_plant_file_are_named_by_key_path(tmp_path: Path) -> None:
    text = EXAMPLE.read_text()
    for old, new in {
        'rate = "-k1*ssqrt(x1) + k4*u"': 'rate = "-k1*ssqrt(x1) + k9*u"',
        "[parameters.k3]\nstart = 0.05": "[parameters.k3]\nstart = 5.0",
        'validation_column = "u_val_V"\n': "",
    }.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "plant.toml"
    path.write_text(text)
    with pytest.raises(ProjectError) as error:
        load_plant(path)
    places_ = [problem.path for problem in error.value.problems]
    assert places_ == ["states.x1.rate", "parameters.k3", "inputs.u.validation_column"]
    path.write_text(
        text.replace('quantity = "level"', 'quantity = "sound"').replace("hold", "hald")
    )
    with pytest.raises(ProjectError) as error:
        load_plant(path)
    assert {"inputs.u.hald", "states.x1.quantity"} <= {p.path for p in error.value.problems}


def table(folder: Path) -> tuple[Path, Path]:
    """A plant of first order and a record of it with a dead zone, as files."""
    plant = folder / "lag.toml"
    plant.write_text(
        '[plant]\nname = "lag"\n[inputs.u]\ncolumn = "u"\nunit = "V"\n'
        '[states.x]\nrate = "b*u - a*x"\nstart = 0\nlow = -5\nhigh = 5\nunit = "m"\n'
        '[outputs.y]\nvalue = "x"\ncolumn = "y"\nunit = "m"\n'
        "[parameters.a]\nstart = 1\nlow = 0.1\nhigh = 10\n"
        "[parameters.b]\nstart = 1\nlow = 0.1\nhigh = 10\n[validation]\nfrom_s = 20\n"
    )
    rng = np.random.default_rng(7)
    t = 0.05 * np.arange(600, dtype=np.float64)
    u = np.repeat(rng.uniform(-2, 2, 30), 20)
    acts = np.sign(u) * np.maximum(abs(u) - 0.5, 0)
    y = run(first_order(), t, acts, 1.5, 2.0, 0.0, sub_steps=4) + 0.01 * rng.standard_normal(600)
    path = folder / "record.csv"
    np.savetxt(path, np.column_stack([t, u, y]), delimiter=",", header="t,u,y", comments="")
    return plant, path


def test_a_record_is_cut_where_the_file_says(tmp_path: Path) -> None:
    plant, path = table(tmp_path)
    records = load_records(load_plant(plant), path)
    assert records.validation is not None
    assert records.identification.t_s[-1] < 20 <= records.validation.t_s[0]
    plant.write_text(plant.read_text().replace("from_s = 20", "from_s = 2000"))
    with pytest.raises(PlantError, match="too few rows"):
        load_records(load_plant(plant), path)


@pytest.mark.usefixtures("eighty")
def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant, path = map(str, table(tmp_path))
    found = in_json("refit", plant, path, "--add", "dead_zone:u")
    assert found["effects"] == [{"effect": "dead_zone", "where": "u"}]
    value = {p["name"]: p for p in found["parameters"]}["dead_zone_u_threshold"]
    assert value["value"] == pytest.approx(0.5, abs=0.02) and value["unit"] == "V"
    assert found["rmse_after"]["validation"]["y"] == pytest.approx(0.01, rel=0.2)
    assert found["rmse_before"]["validation"]["y"] > 0.05
    ends("refit", plant, path, "--add", "dead_zone:u")
    text = capsys.readouterr().out
    assert "error" in text and "dead_zone_u_threshold" in text
    sd = value["std"]  # JSON tells the standard deviation, the table 95 %
    assert f"{1.96 * sd:.2g}" in text and text.count("± is the 95 % interval.") == 1
    assert ends("refit", plant, path, "--add", "overflow:q") == Exit.USAGE
    assert "it may act at: x" in capsys.readouterr().err
