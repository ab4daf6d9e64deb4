"""The door of the page: files that come, roles by click, sizes, and the project that is kept."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

from rtid.errors import RtidError
from rtid.trace.glance import PIECES, Curve, Glance, extremes, glance
from rtid.ui.arrival import Arrival, asked, drawing, fragments
from rtid.ui.desk import Judged
from rtid.ui.server import Workbench
from rtid.ui.shared import READY, Session
from tests.ui.served import served
from tests.ui.test_security import cookie_of, port_of
from tests.ui.test_session import FakeWorker

LINE = np.array([0.0, 1.0])
SEEN = Glance(
    tuple(Curve(n, "bar", LINE, LINE + 1.0) for n in ("pos", "cmd", "P1", "P2", "<odd>")),
    {"u": "cmd", "x": "pos", "p_a": "P1"},
    2,
)


def begun(tmp_path: Path) -> tuple[Session, Arrival, FakeWorker]:
    worker, arrival = FakeWorker(), Arrival(tmp_path)
    (tmp_path / "day.csv").write_text("t,u\n0,1\n")
    (tmp_path / "notes.pdf").write_text("")
    session: Any = Session(tmp_path, None, worker, arrival=arrival)  # type: ignore[arg-type]
    session.open()
    assert session.state == READY and not worker.jobs
    return session, arrival, worker


def test_a_file_is_looked_at_judged_and_kept(tmp_path: Path) -> None:
    session, arrival, worker = begun(tmp_path)
    assert [p.name for p in arrival.files()] == ["day.csv"]
    asked(session, arrival, {"do": "file", "name": "../day.csv"})
    assert worker.jobs[0][:2] == ("glance", (tmp_path / "day.csv", None))
    worker.answer(SEEN)
    assert worker.jobs[0][0] == "judge" and worker.jobs[0][1][3] == {}, "as proposed: at once"
    judged = Judged("good", "The model matches", ("a <line>",), tmp_path / "day.toml", "text\n")
    worker.answer(judged)
    html = "".join(fragments(session, arrival).values())
    assert "Save day.toml and open" in html and "a &lt;line&gt;" in html
    assert "<odd>" not in html and "2 more are not shown" in html
    asked(session, arrival, {"do": "keep"})
    assert (tmp_path / "day.toml").read_text() == "text\n"
    assert session.arrival is None and worker.jobs[0][0] == "read"
    assert worker.jobs[0][1][:2] == (tmp_path / "day.toml", tmp_path / "day.csv")


def test_several_records_are_judged_as_one_until_another_is_taken(tmp_path: Path) -> None:
    """`rtid ui A B` was refused."""
    session, arrival, worker = begun(tmp_path)
    first, second = tmp_path / "day.csv", tmp_path / "next.csv"
    second.write_text(first.read_text())
    arrival.file, arrival.more = first, (second,)
    session.open()
    worker.answer(SEEN)
    assert worker.jobs[0][0] == "judge" and worker.jobs[0][1][4] == (second,)
    worker.answer(Judged("good", "The model matches", (), tmp_path / "day.toml", "text\n"))
    pressed = fragments(session, arrival)["arrival_files"].count('aria-pressed="true"')
    assert pressed == 2
    asked(session, arrival, {"do": "file", "name": "next.csv"})
    assert not arrival.more


@pytest.mark.parametrize(
    ("roles", "is_judged"),
    [({"u": "cmd", "v": "y"}, True), ({"u": "cmd", "p_a": "P1"}, False), ({"v": "y"}, False)],
)
def test_without_pressures_a_command_is_enough(
    tmp_path: Path, roles: dict[str, str], is_judged: bool
) -> None:
    session, arrival, worker = begun(tmp_path)
    asked(session, arrival, {"do": "file", "name": "day.csv"})
    worker.answer(replace(SEEN, roles=roles))
    assert [job[0] for job in worker.jobs] == ["judge"] * is_judged


def test_what_has_no_maps_is_told_and_not_opened(tmp_path: Path) -> None:
    session, arrival, worker = begun(tmp_path)
    asked(session, arrival, {"do": "file", "name": "day.csv"})
    worker.answer(SEEN)
    worker.answer(Judged("good", "The model matches", ("Next: rtid quick",), None, "text\n"))
    html = "".join(fragments(session, arrival).values())
    assert "Next: rtid quick" in html and "and open" not in html
    asked(session, arrival, {"do": "keep"})
    assert session.arrival is arrival and not list(tmp_path.glob("*.toml"))


def test_a_project_that_came_in_the_meantime_is_not_overwritten(tmp_path: Path) -> None:
    session, arrival, _ = begun(tmp_path)
    (tmp_path / "day.toml").write_text("mine")
    arrival.file = tmp_path / "day.csv"
    arrival.judged = Judged("", "", (), tmp_path / "day.toml", "")
    asked(session, arrival, {"do": "keep"})
    assert (tmp_path / "day.toml").read_text() == "mine"
    assert "day.toml" in session.trouble[0] and session.arrival is arrival


def test_roles_and_sizes_are_what_was_clicked_and_typed(tmp_path: Path) -> None:
    session, arrival, worker = begun(tmp_path)
    asked(session, arrival, {"do": "file", "name": "day.csv"})
    worker.answer(SEEN)
    worker.jobs.clear()
    assert arrival.role == "p_b", "the first that nobody plays"
    asked(session, arrival, {"do": "curve", "name": "P2"})
    asked(session, arrival, {"do": "role", "name": "x"})
    asked(session, arrival, {"do": "curve", "name": "P1"})
    assert arrival.roles == {"u": "cmd", "x": "P1", "p_b": "P2"}
    for name, typed in (("bore", "63"), ("rod", "36,5"), ("dead_b", "0.4"), ("stroke", "x")):
        asked(session, arrival, {"do": "size", "size": name, "name": typed})
    assert "stroke" in session.trouble[0]
    asked(session, arrival, {"do": "judge"})
    _, (file, dbc, given, chosen, more), _ = worker.jobs[0]
    assert more == ()
    assert (file, dbc, chosen) == (tmp_path / "day.csv", None, {"x": "P1", "p_b": "P2"})
    assert (given.bore_m, given.rod_m, given.stroke_m) == (0.063, 0.0365, None)
    assert given.dead_volumes_m3 == (0.4e-3, 0.4e-3)
    asked(session, arrival, {"do": "size", "size": "bore", "name": ""})
    assert arrival.given().bore_m is None


def test_sizes_that_are_none_are_refused(tmp_path: Path) -> None:
    for typed in ("0", "-1", "nan", "inf", "a"):
        with pytest.raises(RtidError, match="bore"):
            Arrival(tmp_path).measure("bore", typed)
    assert "not thinner" in drawing({"bore": 0.03, "rod": 0.05})
    assert "31.2 cm²" in drawing({"bore": 0.063}) and "rod 44.1 mm?" in drawing({"bore": 0.063})


def test_a_curve_keeps_what_is_short_and_what_is_missing() -> None:
    values = np.zeros(10_000)
    values[5_000], values[7_000] = 9.0, np.nan
    low, high = extremes(values)
    assert len(high) == PIECES and high.max() == 9.0 and low.max() == 0.0
    assert np.isfinite(high).all()
    assert len(extremes(values[:3])[0]) == 3


def test_a_glance_proposes_roles(tmp_path: Path) -> None:
    t = np.arange(200) * 0.01
    table = np.column_stack([t, np.sin(t), 100 + 50 * np.sin(t), 30 + t, 40 - t, 0 * t + 7])
    path = tmp_path / "t.csv"
    header = "time [s],valve [V],pos [mm],P1 [bar],P2 [bar],oil [degC]"
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    seen = glance(path)
    assert seen.roles == {"u": "valve", "x": "pos", "p_a": "P1", "p_b": "P2"}
    assert {c.name for c in seen.curves} == {"valve", "pos", "P1", "P2", "oil"}


@pytest.fixture(scope="module")
def door(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Workbench, Path]]:
    folder = tmp_path_factory.mktemp("door")
    (folder / "here.csv").write_text("not a table")
    with served(project=None, trace=folder / "here.csv") as bench:
        yield bench, folder


def post(bench: Workbench, name: str, body: bytes, **headers: str) -> SimpleNamespace:
    connection = http.client.HTTPConnection("127.0.0.1", port_of(bench), timeout=20)
    own = {"Cookie": cookie_of(bench), "Origin": f"http://127.0.0.1:{port_of(bench)}"}
    kept = {k: v for k, v in (own | headers).items() if v}
    connection.request("POST", f"/arrive?name={quote(name)}", body, kept)
    answer = connection.getresponse()
    return SimpleNamespace(status=answer.status, text=answer.read().decode())


def test_a_dropped_file_lies_in_the_folder(door: tuple[Workbench, Path]) -> None:
    bench, folder = door
    body = b"t,a\n" + b"0,1\n" * 50_000  # more than any other request may bring
    assert post(bench, "../../new day.csv", body).status == 204
    assert (folder / "new day.csv").read_bytes() == body
    assert post(bench, "new day.csv", b"2").status == 204, "nothing is overwritten"
    assert (folder / "new day-2.csv").read_bytes() == b"2"
    assert not list(folder.glob(".*"))


def test_strangers_and_strange_files_are_refused(door: tuple[Workbench, Path]) -> None:
    bench, folder = door
    before = sorted(folder.iterdir())
    assert post(bench, "a.csv", b"1", Cookie="").status == 401
    assert post(bench, "a.csv", b"1", Origin="").status == 405
    assert post(bench, "a.csv", b"1", Origin="http://evil.example").status == 403
    refused = post(bench, "a.exe", b"1")
    assert refused.status == 415 and "a.exe" in refused.text
    assert sorted(folder.iterdir()) == before
