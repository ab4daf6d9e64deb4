"""What a page of the catalogue says of an effect is what the diagnosis' column has."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rtid
from rtid.cli import main
from rtid.diagnose.fit import first_map, prepare
from rtid.diagnose.unseen import HYDRAULIC
from rtid.effects import Effect, EffectError, Parameter, catalogue
from rtid.effects.column import Cause, fixed, of_page
from rtid.effects.law import is_of_rates, lines_of, places_of
from rtid.effects.laws import NAMED, cause_of, causes, law_of
from rtid.effects.laws.pump import PUMP
from rtid.effects.laws.timing import COMMAND_LAWS, TIMINGS, TimingLaw
from rtid.effects.magnitude import page_for
from rtid.effects.record_view import RecordView
from rtid.plants.entries import effects_of_plants
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.diagnose.records import record

LAG = "time_constant"  # of a sag: resistance / stiffness, the two that its page has
HOMES = {"rtid/sim/hideable.py", "rtid/sim/other_plants.py"}  # what is hidden in simulations


def parameters(name: str) -> dict[str, Parameter]:
    return {p.name: p for p in catalogue()[name].parameters}


@pytest.mark.parametrize("page", catalogue().values(), ids=lambda page: page.name)
def test_every_page_has_a_law_or_says_why_not(page: Effect) -> None:
    """Its equation, a law by name, or a term of a plant by equations; no law only with a reason."""
    laws = [bool(lines_of(page)) and not page.law, bool(page.law), bool(page.no_law)]
    if page.kind in HYDRAULIC:
        assert sum(laws) == 1, laws
        assert not page.law or page.law in COMMAND_LAWS or callable(law_of(page))
    else:
        assert not page.no_law
        assert is_of_rates(page) or page.name in effects_of_plants()


def test_every_column_is_that_of_its_page() -> None:
    """Range, sign, unit and parameter; a nonlinear parameter stays between the page's bounds."""
    model, chunk, _ = record()
    weights = prepare(model, chunk)
    found = causes(RecordView.of(model, chunk, weights, first_map(model, chunk, weights)))
    of_pressures = {n: page for n, page in catalogue().items() if not is_of_rates(page)}
    by_law = {n for n, page in of_pressures.items() if lines_of(page) or page.law in NAMED}
    assert {c.candidate.effect for c in found} == by_law
    for cause in found:
        column = cause.candidate
        page_here = page_for(catalogue()[column.effect], model)
        pages = {p.name: p for p in page_here.parameters}
        if not column.is_whole:
            size = pages[column.parameter]
            if column.parameter == size.name and column.parameter != "stiffness":
                assert size == page_here.size
            assert (column.unit, column.largest, column.sign) == (size.unit, size.high, size.sign)
        for k, (name, unit) in enumerate(zip(column.shape_names, column.shape_units, strict=True)):
            if name != LAG:
                (low, high), page = cause.bounds(k), column.page_of(k)
                assert page is not None and (page.name == name or column.is_whole)
                assert unit == page.unit and page.low <= low
                assert high <= page.high, column


@pytest.mark.parametrize("timing", [*TIMINGS, PUMP], ids=lambda t: t.effect)
def test_every_timing_is_that_of_its_page(timing: TimingLaw) -> None:
    pages = parameters(timing.effect)
    parts = zip(timing.parameters, timing.units, timing.low, timing.high, strict=True)
    for name, unit, low, high in parts:
        assert (pages[name].unit, pages[name].low, pages[name].high) == (unit, low, high), name
    alike = [t for t in (*TIMINGS, PUMP) if t.effect == timing.effect]
    assert {name for t in alike for name in t.parameters} == set(pages)


def test_no_code_asks_for_an_effect_by_its_name() -> None:
    """What it wants to know of one is on the page; only what is simulated has names."""
    root, names = Path(rtid.__file__).parents[1], set(catalogue())
    homes = set()
    for path in (root / "rtid").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                is_name = re.split("[:=]", node.value)[0] in names - WORDS
                homes |= {path.relative_to(root).as_posix()} if is_name else set()
    assert homes <= HOMES


WORDS = {"offset", "overflow"}  # of the page in the browser, and of a motion


def steady(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """A law of a package of somebody's own: a steady flow into the first chamber."""
    yield fixed(of_page(effect, "a"), lambda: {0: view.dt_s})


def test_a_law_is_a_function_of_any_package() -> None:
    model, chunk, _ = record()
    view = RecordView.without_map(model, chunk[:100], np.full(2, 1e-9))
    page = replace(catalogue()["line_dynamics"], name="mine", law=f"{__name__}:steady")
    mine = causes(view, (page,))[-1]
    assert mine.candidate.key == ("mine", "a") and mine.candidate.unit == page.size.unit
    assert cause_of(view, mine.candidate).column(())[0] is view.dt_s
    with pytest.raises(EffectError, match="no law 'no_module:x'") as refused:
        causes(view, (replace(page, law="no_module:x"),))
    assert "package.module:function" in refused.value.remedy


def test_an_equation_in_names_that_no_record_has_is_refused() -> None:
    page = replace(catalogue()["internal_leakage_laminar"], equation=("q_c = -C_il * p_x",))
    model, _, _ = record()
    with pytest.raises(EffectError, match="uses p_x, which no record has"):
        list(places_of(replace(page, places=("chamber",)), model, np.full(2, 1e-9)))


def test_what_nobody_looked_for_is_said_to_be_not_examined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = tmp_path / "run.parquet"
    write_run(trace, simulate(SimulatedPlant(), "sweep", 0, 25.0), 0, "sweep")
    with pytest.raises(SystemExit):
        main.run(["diagnose", str(trace), "-p", str(trace.with_suffix(".toml")), "--json"])
    unseen = json.loads(capsys.readouterr().out)["not_found"]
    unexamined = {u["effect"] for u in unseen if not u["examined"]}
    assert {"deadband_shift", "pressure_sensor_bias", "load_compensated_valve"} <= unexamined
    assert not {"drive_leakage", "drive_compliance", "map_lag"} & unexamined  # of other machines
    for one in unseen:
        assert one["examined"] != one["reason"].startswith("Not examined")
        limit, name = one["detection_limit"], one["effect"]
        first = catalogue()[name].parameters[0]
        if limit is not None and first.unit == one["unit"] == "s":
            assert limit <= first.high, one
        assert one["visible"] <= (limit is not None), one
