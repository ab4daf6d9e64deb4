"""Tables of plants that empty or cool down by themselves: `rtid quick` takes their equations.

The tables are solved by scipy, not by the free run that is fitted to them.  The measured tanks are
those of nonlinearbenchmark.org (Schoukens and Noel, 2017).
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtid.cli.init import init
from rtid.plain import FloatArray, silent
from rtid.project.guess import RoleCandidate, named, propose
from rtid.project.plant_file import load_plant
from rtid.study.quick import quick
from rtid.study.quick_machine import Given
from rtid.study.quick_plant import QuickPlant, equations_of, moves_itself
from rtid.study.rate_pairs import RatePair
from rtid.study.structures import BODIES, VESSELS
from rtid.trace.quick_source import open_source
from rtid.ui import desk


def commands(rng: np.random.Generator, n: int, held: int, low: float, high: float) -> FloatArray:
    """Steps (n,) of random height, each held so many samples."""
    return np.repeat(rng.uniform(low, high, n // held + 1), held)[:n]


def solved(rates: object, start: list[float], u: FloatArray, step_s: float) -> FloatArray:
    """States (n, states) at even steps under held commands (n,)."""
    x = [np.array(start)]
    for k in range(len(u) - 1):
        run = solve_ivp(rates, (0.0, step_s), x[-1], args=(u[k],), rtol=1e-8, atol=1e-10)  # type: ignore[call-overload]
        x.append(run.y[:, -1])
    return np.array(x)


def heater(file: Path) -> Path:
    """A table of a body that cools down to 21 degC in some 200 s, a row each 2 s."""
    rng = np.random.default_rng(3)
    u = commands(rng, 900, 60, 0.0, 100.0)
    warm = solved(lambda _, x, u: 0.004 * u - (x - 21.0) / 200.0, [21.0], u, 2.0)[:, 0]
    rows = np.column_stack([2.0 * np.arange(len(u)), u, warm + 0.05 * rng.standard_normal(len(u))])
    np.savetxt(file, rows, "%.3f", ",", header="t_s,heater_pct,temp_degC", comments="")
    return file


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e3, 1e7])
def test_what_moves_itself_does_so_in_any_unit(scale: float) -> None:
    """Of a vessel that x explains 0.64 of, it was nothing in 1e-7 of its unit, and -0.48 in 1e7."""
    t_s, x = np.arange(1000.0), np.zeros(1000)
    rng = np.random.default_rng(0)
    u = commands(rng, 1000, 20, 0.0, 5.0)
    for k in range(999):
        x[k + 1] = x[k] + 0.3 * u[k] - 0.1 * x[k]
    x += 0.01 * rng.standard_normal(1000)
    once = moves_itself(t_s, u, x)
    assert once > 0.5
    assert moves_itself(t_s, u, scale * x) == pytest.approx(once, rel=1e-6)
    assert moves_itself(t_s, u, 0.0 * x) == 0.0


def test_a_heater_is_a_body_that_loses_heat(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = heater(tmp_path / "oven.csv")
    looked = quick(table)
    assert isinstance(looked, QuickPlant)
    assert looked.found.structure is BODIES[0]
    loss, sd = looked.refitted.first.fit.value("a")
    assert loss == pytest.approx(1.0 / 200.0, rel=0.02) and sd < 0.02 * loss
    assert not looked.diagnosis.found
    monkeypatch.setattr(desk, "quick", lambda *_: looked)  # the page's door says the same
    judged = desk.Desk(silent).judge(table, None, Given(), {})
    assert judged.heading == "The model matches" and judged.project is None
    assert any(line.startswith("  d x / dt = ") for line in judged.lines)


def test_a_column_of_two_words_is_one_word_on_the_command_line() -> None:
    command = RoleCandidate("Sollwert Ventil", "", "V", 0.0, 10.0)
    pair = RatePair(command, RoleCandidate("Hub", "", "mm", 0.0, 500.0), 0.9, 5.0)
    assert shlex.split(pair.options) == ["--role", "u=Sollwert Ventil", "--role", "x=Hub"]


def test_init_writes_its_plant_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, file = heater(tmp_path / "oven.csv"), tmp_path / "oven.toml"
    init(str(table), file)
    assert f"rtid refit {file}" in capsys.readouterr().out
    plant = load_plant(file)
    assert [s.quantity for s in plant.plant.states] == ["temperature"]


def test_what_stands_where_it_is_left_is_a_rate() -> None:
    rng = np.random.default_rng(4)
    u, t_s = commands(rng, 1500, 20, -5.0, 5.0), np.linspace(0.0, 74.95, 1500)
    late = np.concatenate([np.zeros(4), u[:-4]])
    x: FloatArray = np.cumsum(0.4 * late) + 0.1 * rng.standard_normal(len(u))
    assert moves_itself(t_s, u, x) < 0.02


@pytest.mark.parametrize("is_vessel", [True, False])
def test_the_law_is_told_by_the_record_and_not_by_its_names(
    tmp_path: Path, is_vessel: bool
) -> None:
    """Two in a row, in volts: by roots or by straight lines, whatever the columns are called."""
    rng = np.random.default_rng([31, is_vessel])
    u = commands(rng, 900, 30, 0.5, 6.0)

    def rates(_: float, x: FloatArray, u: float) -> list[float]:
        if is_vessel:
            first, last = 0.06 * np.sqrt(np.maximum(x, 0.0))
        else:
            first, last = 0.025 * x
        return [0.045 * u - first, first - last]

    y = solved(rates, [4.0, 4.0], u, 4.0)[:, 1] + 0.02 * rng.standard_normal(len(u))
    for name in ("tank", "oven"):
        file = tmp_path / f"{name}.csv"
        rows = np.column_stack([4.0 * np.arange(len(u)), u, y])
        np.savetxt(file, rows, "%.4f", ",", header=f"t_s,pump_V,{name}_level_V", comments="")
        source = open_source(file, None)
        given = named(source.signals, {"u": "pump_V", "x": f"{name}_level_V"})
        found = equations_of(file, source, given)
        assert found is not None and found.structure is (VESSELS if is_vessel else BODIES)[1]


def test_volts_behind_a_name_are_no_velocity() -> None:
    volts, speed = (RoleCandidate(n, "", "", 0.0, 10.0) for n in ("y_est_V", "v_ist"))
    assert "v" not in propose([volts]) and propose([volts, speed])["v"].name == "v_ist"


@pytest.mark.long
def test_measured_tanks_go_the_way_of_equations(shared: Path, tmp_path: Path) -> None:
    """0.669 -> 0.263 V on the record of the table that judges."""
    table = shared / "data" / "real" / "cascaded_tanks.csv"
    looked = quick(table)
    assert isinstance(looked, QuickPlant) and looked.found.structure is VESSELS[1]
    found = looked.found
    assert found.record.others == ("u_val_V", "y_val_V") and found.record.same_start
    assert found.pair.state.unit == "V"
    refitted = looked.refitted
    assert refitted.errors(refitted.first)["validation"][0] == pytest.approx(0.669, abs=0.002)
    assert refitted.errors(refitted.last)["validation"][0] == pytest.approx(0.263, abs=0.003)
    assert looked.diagnosis.found[0].key == ("overflow", "x1")
    renamed = tmp_path / "record.csv"
    words = table.read_text()
    for old, new in {"u_": "drive_", "y_": "probe_"}.items():
        words = re.sub(rf"\b{old}(est|val)_V", rf"{new}\1", words)
    renamed.write_text(words)
    source = open_source(renamed, None)
    roles = named(source.signals, {"u": "drive_est", "x": "probe_est"})
    other = equations_of(renamed, source, roles)
    assert other is not None and other.structure is VESSELS[1]
