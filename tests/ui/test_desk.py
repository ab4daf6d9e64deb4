"""The desk: add, drop, undo, save and export, with the commands' own history; other machines."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.sources.errors import LogError
from rtid.diagnose.extend import as_diagnosed, extend
from rtid.errors import RtidError
from rtid.maps.files import read_map
from rtid.project import load
from rtid.project.history import ADD, read
from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.study.look import Look
from rtid.study.revisions import undo
from rtid.study.study import Study
from rtid.ui.desk import Desk
from rtid.ui.release_form import ReleaseWish
from rtid.ui.shared import NAMED
from rtid.ui.worker import in_words
from tests.replays import shared_replays  # noqa: F401

pytestmark = pytest.mark.slow
SEED, DURATION_S = 3, 30.0
LEAK = "internal_leakage_laminar", "a-b"


def silent(_text: str, _share: float) -> None:
    pass


@pytest.fixture(scope="module")
def worn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("my desk")
    machine = hide_wish(draw(SEED), "internal_leakage_laminar=strong")
    run = simulate(machine, "rich", SEED, DURATION_S)
    trace, _, project = write_run(folder / "worn.parquet", run, SEED, "rich")
    return trace, project


def left(look: Look) -> float:
    """Root mean square of what a revision leaves of the held-out flow, both chambers."""
    part = look.parts.get("validation") or look.parts["identification"]
    return float(np.sqrt(np.mean(part.equation.residual_m3s**2)))


def fit(look: Look) -> float:
    part = look.parts.get("validation") or look.parts["identification"]
    return float(part.runs["free run"].fit_percent.min())


@pytest.mark.long
def test_the_whole_way_of_an_effect(worn: tuple[Path, Path]) -> None:
    trace, project = worn
    untouched, desk = project.read_bytes(), Desk(silent)
    first = desk.open(project, trace, None).look
    named = desk.diagnose().diagnosis.found[0]
    assert (named.effect, named.where) == LEAK
    foretold = desk.tried(*LEAK, NAMED)
    desk.prepare(*LEAK, NAMED)
    added = desk.add(*LEAK, NAMED)
    assert added == foretold, "what the page tells before the maps are learned"
    seen = desk.look()
    assert left(seen) < 0.25 * left(first)
    assert fit(seen) > fit(first) + 10
    size = added.section.parameters["coefficient"]
    assert size.value == pytest.approx(named.parameters["coefficient"].value, rel=1e-3)
    pair = added.section.errors.heldout_pct
    assert pair.before is not None
    assert pair.after is not None
    assert pair.after < 0.2 * pair.before
    desk.back(1)
    with pytest.raises(RtidError, match="spool_lag_of_the_moon"):
        desk.add("spool_lag_of_the_moon", "", "")
    desk.add(*LEAK, "once more")
    again = desk.look()
    assert left(again) == pytest.approx(left(seen))
    dropped = desk.drop(*LEAK)
    assert left(desk.look()) == pytest.approx(left(first), rel=1e-9)
    assert dropped.sections == ()
    desk.back(2)
    assert project.read_bytes() == untouched
    (line,) = re.findall(r"`(rtid undo[^`]*)` takes", desk.save().note)
    assert shlex.split(line) == ["rtid", "undo", "-p", str(project)]
    assert [a.key for a in load(project).sections.added] == [LEAK]
    assert [change.change for change in read(project)] == [ADD]
    desk.take_back()
    assert project.read_bytes() == untouched
    desk.add(*LEAK, "for good")
    assert desk.look() != again, "Where compares what it shows, and raised on the arrays in it"
    desk.save()
    desk.release(ReleaseWish(".npz"))
    flowmap, _ = read_map(trace.with_suffix(".map.npz"))
    assert np.array_equal(flowmap.edges[0].theta, again.flowmap.edges[0].theta)
    reopened = Desk(silent).open(project, trace, None)
    assert [a.key for a in reopened.added] == [LEAK]
    assert left(reopened.look) == pytest.approx(left(again), rel=0.02)
    undo(project)
    assert project.read_bytes() == untouched


def test_what_the_diagnosis_has_fitted_is_not_fitted_again(worn: tuple[Path, Path]) -> None:
    trace, project = worn
    study = Study(project, trace)
    known = as_diagnosed(study.standing, study.diagnosed.result, LEAK)
    again = extend(study.standing, *LEAK)
    assert known is not None and study.tried(*LEAK).after.fit is study.diagnosed.result.last
    assert (known.gain, known.against, known.better) == (again.gain, again.against, again.better)
    assert np.array_equal(known.after.fit.held.theta, again.after.fit.held.theta)
    assert np.array_equal(known.after.fit.map.cov, again.after.fit.map.cov)
    assert known.after.fit.spreads == again.after.fit.spreads


@pytest.mark.long
def test_what_would_do_better_stands_beside_what_speaks_against(worn: tuple[Path, Path]) -> None:
    """What a modulus alone tells is to be declared: the page says so as the command does."""
    trace, project = worn
    desk = Desk(silent)
    desk.open(project, trace, None)
    words = desk.tried("extra_dead_volume", "b", "by name").note
    tried = Study(project, trace).tried("extra_dead_volume", "b")
    assert tried.against and tried.better
    assert words == "; ".join((*tried.against, tried.better))


def test_a_file_that_was_changed_meanwhile_is_not_overwritten(worn: tuple[Path, Path]) -> None:
    trace, project = worn
    copy = project.with_name("copy.toml")
    copy.write_bytes(project.read_bytes())
    desk, other = Desk(silent), Desk(silent)
    for one in (desk, other):
        one.open(copy, trace, None)
        one.add(*LEAK, "by name")
    other.save()
    saved = copy.read_bytes()
    with pytest.raises(RtidError, match="other effects"):
        desk.save()
    assert copy.read_bytes() == saved


def test_a_wrong_format_or_record_is_refused_in_words(
    worn: tuple[Path, Path], tmp_path: Path
) -> None:
    trace, project = worn
    desk = Desk(silent)
    with pytest.raises(LogError) as refusal:
        desk.open(project, tmp_path / "absent.blf", None)
    assert in_words("open", refusal.value)[0].endswith("absent.blf: no such file")
    assert in_words("open", ZeroDivisionError("x"))[1].startswith("a defect")
    desk.open(project, trace, None)
    with pytest.raises(RtidError, match="no format"):
        desk.export("../../etc/passwd")
    with pytest.raises(RtidError, match="no format"):
        desk.release(ReleaseWish("/../../etc/passwd"))
