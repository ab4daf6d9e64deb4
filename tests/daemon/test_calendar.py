"""This week beside the last one, notes on spans, and metrics over HTTP with their board."""

from __future__ import annotations

import json
import re
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pytest

from rtid.daemon import metrics, scrape, status
from rtid.daemon.calendar import (
    SpanNote,
    calendar_table,
    notes,
    side_by_side,
    trend,
    two_spans,
    write_note,
)
from rtid.daemon.chronicle import DAY_S, FILE, Chronicle
from rtid.daemon.jobs import Publication
from rtid.errors import RtidError
from rtid.estimator.flowmap import FlowMap
from tests.command import ends, in_json
from tests.daemon.test_parts import full_status

NOW_S = 1.8e9


@pytest.fixture
def history(tmp_path: Path) -> Path:
    """Ten days in which chamber a softens by a tenth at the middle, and an alarm comes."""
    Chronicle(tmp_path).close()
    with closing(sqlite3.connect(tmp_path / FILE)) as base:
        for k in range(100):
            at_s, is_late = NOW_S - (99 - k) * 0.1 * DAY_S - 1.0, k >= 50
            for name, beta in (("a", 9e8 if is_late else 1e9), ("b", 1e9)):
                row = (at_s, name, beta + (k % 2) * 1e6, 1e6)
                base.execute("INSERT INTO estimate VALUES (?, ?, ?, ?)", row)
            base.execute("INSERT INTO map VALUES (?, 'pa', ?, 40, 1.0)", (at_s, 10 + k // 10))
        for row in ((NOW_S - 9.0, "b", 1e9, float("inf")), (NOW_S - 8.0, "b", float("inf"), 1e6)):
            base.execute("INSERT INTO estimate VALUES (?, ?, ?, ?)", row)  # not known yet
        alarm = (NOW_S - DAY_S, "plant_changed", "plant", "said", 0)
        base.execute("INSERT INTO alarm VALUES (?, ?, ?, ?, ?)", alarm)
        base.commit()
    return tmp_path


def test_two_weeks_stand_side_by_side(history: Path) -> None:
    rows = side_by_side(history, *two_spans(5.0, NOW_S))
    by_name = {row.name: row for row in rows}
    soft, steady = by_name["bulk modulus a"], by_name["bulk modulus b"]
    assert soft.before and soft.now and steady.before and steady.now
    assert soft.before[0] == pytest.approx(1.0005e9, rel=1e-6)
    assert soft.now[0] == pytest.approx(0.9005e9, rel=1e-6)
    assert soft.now[1] == pytest.approx(0.5e6, rel=1e-3)
    assert by_name["alarm plant_changed"].before is None
    cells = {r[0]: r for r in calendar_table(5.0, rows).rows}
    assert cells["bulk modulus a MPa"][3:] == ("-100", "more than both scatter")
    assert cells["bulk modulus b MPa"][4] == ""
    lines = {line.name: line for line in trend(history, NOW_S - 5 * DAY_S)}
    assert len(lines["bulk modulus a"].points) == 50
    assert lines["bulk modulus a"].points[-1] == pytest.approx((NOW_S - 1.0, 9.01e8, 1e6))


def test_sizes_and_the_lag_are_kept_with_their_intervals(tmp_path: Path) -> None:
    """Those learned on board from every publication, the others from every diagnosis."""
    value = {"value": 2e-12, "std": 1e-13, "unit": "m3/s/Pa"}
    leak = {"effect": "leak", "where": "a-b", "parameters": {"coefficient": value}}
    timing = {"value": 2e-3, "std": 1e-4, "unit": "s"}
    late = {"effect": "late", "where": "u", "parameters": {"delay": timing, "no": {"value": None}}}
    content = {"lag_s": 5e-3, "lag_sd_s": 2e-4, "added": [leak], "found": [late]}
    history, since_s = Chronicle(tmp_path), time.time() - 100.0
    for k in range(4):
        verdict = status.Verdict(since_s + 10 * k, "missing", "said", content=content)
        history.note_verdict(verdict)
        size = status.EffectStatus("leak a-b", 2e-12 + k * 1e-13, 1e-13, "m3/s/Pa")
        history.note_publication(publication(size), [])
    history.note_verdict(replace(verdict, content={"lag_s": 5e-3}))
    history.close()
    lines = {line.name: line for line in trend(tmp_path, 0.0)}
    assert [len(lines[name].points) for name in ("spool lag", "late u")] == [4, 4]
    assert lines["spool lag"].points[0] == pytest.approx((since_s, 5e-3, 2e-4))
    assert (lines["late u"].unit, lines["leak a-b"].unit) == ("s", "m3/s/Pa")
    assert len(learned_on_board(tmp_path)) == 5  # one of the first diagnosis, before any on board
    rows = {row.name: row for row in side_by_side(tmp_path, *two_spans(1.0))}
    assert rows["spool lag"].now == pytest.approx((5e-3, 0.0), abs=1e-9)


def test_an_estimate_counts_where_it_is_known(tmp_path: Path) -> None:
    """Not the first of a modulus, from hardly any data; what came back to zero is known there."""
    Chronicle(tmp_path).close()
    moduli = [(-1.4e10, 1.7e11), (2e9, 1.5e9), (1e9, 1e7), (1.1e9, 1e7)]
    leaks = [(-9e-10, 8e-9), (2e-12, 1e-13), (0.0, 1e-13), (1e-12, 1e-13)]
    with closing(sqlite3.connect(tmp_path / FILE)) as base:
        for k, (modulus, leak) in enumerate(zip(moduli, leaks, strict=True)):
            at_s = NOW_S - 90.0 + 10.0 * k
            base.execute("INSERT INTO estimate VALUES (?, 'a', ?, ?)", (at_s, *modulus))
            base.execute("INSERT INTO estimate VALUES (?, 'b', ?, ?)", (at_s, *moduli[0]))
            row = (at_s, "leak", "m3/s/Pa", *leak)
            base.execute("INSERT INTO quantity VALUES (?, ?, ?, ?, ?)", row)
            base.execute("INSERT INTO quantity VALUES (?, 'wear of pa', '', 0, 0)", (at_s,))
        base.commit()
    rows = {row.name: row for row in side_by_side(tmp_path, *two_spans(1.0, NOW_S))}
    assert rows["bulk modulus a"].now == pytest.approx((1.05e9, 5e7))
    assert rows["leak"].now == pytest.approx((1e-12, 1e-12 * (2 / 3) ** 0.5))
    assert rows["wear of pa"].now == (0.0, 0.0) and "bulk modulus b" not in rows
    lines = {line.name: [v for _, v, _ in line.points] for line in trend(tmp_path, 0.0)}
    assert lines["bulk modulus a"] == [1e9, 1.1e9]
    assert lines["leak"] == [2e-12, 0.0, 1e-12] and "bulk modulus b" not in lines


def test_a_history_of_an_older_daemon_has_no_sizes(history: Path) -> None:
    with closing(sqlite3.connect(history / FILE)) as base:
        base.execute("DROP TABLE quantity")
        base.commit()
    assert [line.name for line in trend(history, 0.0)] == ["bulk modulus a", "bulk modulus b"]
    assert side_by_side(history, *two_spans(5.0, NOW_S))


def test_a_trend_is_thinned_to_means(tmp_path: Path) -> None:
    Chronicle(tmp_path).close()
    with closing(sqlite3.connect(tmp_path / FILE)) as base:
        rows = [(NOW_S + k, "a", 1e9 + k % 2, 1e6) for k in range(10_000)]
        base.executemany("INSERT INTO estimate VALUES (?, ?, ?, ?)", rows)
        base.commit()
    (line,) = trend(tmp_path, NOW_S)
    assert 390 <= len(line.points) <= 400
    assert all(v == pytest.approx(1e9 + 0.5, abs=0.1) for _, v, _ in line.points[:-1])
    times = [t for t, _, _ in line.points]
    assert times == sorted(times) and times[-1] - times[0] > 9_900


def publication(*effects: status.EffectStatus) -> Publication:
    """Of a machine without valves, as far as a history is told of it."""
    none = np.empty(0)
    return Publication(1, FlowMap(()), none, none, 1.0, 0.0, (), 0.1, effects)


def learned_on_board(folder: Path) -> list[tuple[float, ...]]:
    with closing(sqlite3.connect(folder / FILE)) as base:
        return base.execute("SELECT value FROM quantity WHERE name = 'leak a-b'").fetchall()


def test_a_note_stands_with_its_span_and_no_other(history: Path) -> None:
    before, now = two_spans(5.0, NOW_S)
    assert notes(history, now) == []
    write_note(history, SpanNote(now.from_s, now.until_s, "ann", "new oil"))
    assert [note.text for note in notes(history, now)] == ["new oil"]
    assert notes(history, two_spans(5.0, before.from_s)[1]) == []


def test_the_command_says_it(
    history: Path, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    project = tmp_path_factory.mktemp("project") / "m.toml"
    project.write_text(f'[daemon]\nfolder = "{history}"\n')
    words = ["history", "-p", str(project), "--days", "5", "--until", "2027-01-15T09:00"]
    ends(*words, "--note", "new oil")
    said = capsys.readouterr().out
    assert "bulk modulus a MPa" in said and "new oil" in said and "Next: " in said
    told = in_json(*words)
    assert told["notes"][0]["text"] == "new oil" and told["rows"]


def test_no_history_is_said(tmp_path: Path) -> None:
    with pytest.raises(RtidError, match="no history"):
        side_by_side(tmp_path, *two_spans(7.0))
    (tmp_path / FILE).write_text("no database, but long enough to be taken for one" * 9)
    with pytest.raises(RtidError, match="history"):
        side_by_side(tmp_path, *two_spans(7.0))


@contextmanager
def scraped(folder: Path) -> Iterator[str]:
    with scrape.server(folder, "0") as answers:
        thread = threading.Thread(target=answers.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{answers.server_address[1]}"
        answers.shutdown()
        thread.join()


def test_a_scraper_gets_the_metrics_and_nothing_else(tmp_path: Path) -> None:
    with scraped(tmp_path) as url:
        with pytest.raises(HTTPError, match="503"):
            urlopen(f"{url}/metrics", timeout=10)
        status.write(tmp_path, full_status())
        with urlopen(f"{url}/metrics", timeout=10) as answer:
            assert answer.headers["Content-Type"] == scrape.KIND
            assert b'rtid_bulk_modulus_pascals{machine="boom",chamber="b"}' in answer.read()
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"{url}/status.json", timeout=10)


@pytest.mark.parametrize("place", ["", "x", "99999999", "1.2.3.4.5:80"])
def test_a_place_that_is_none_is_refused(tmp_path: Path, place: str) -> None:
    with pytest.raises((RtidError, OSError)) as refusal:
        scrape.server(tmp_path, place)
    assert isinstance(refusal.value, RtidError)


def test_the_board_shows_metrics_that_there_are() -> None:
    board = json.loads(Path(metrics.__file__).with_name("board.json").read_text("utf-8"))
    plain = full_status()
    result = replace(
        plain.estimate, surprise=1.0, refused={"range": 1},
        edges=(status.EdgeHealth("pa", {"valid": 3}, progress=0.5),),
    )  # fmt: skip
    message = status.MessageHealth("m", 1, 100.0, 99.0, 0.01, 0.02, "ok", {})
    verdict = status.Verdict(1.0, "missing", "said", ("internal_leakage_laminar",))
    full = replace(
        plain, estimate=result, messages=(message,), verdict=verdict,
        store=replace(plain.store, age_s=1.0),
    )  # fmt: skip
    told = metrics.exposition(full, 0.5)
    known = set(re.findall(r"^# TYPE (\w+)", told, re.M))
    asked = {
        name
        for panel in board["panels"]
        for target in panel["targets"]
        for name in re.findall(r"rtid_\w+", target["expr"])
    }
    assert len(asked) > 12 and asked <= known, asked - known
