"""The instruments of the live page: a minute of signals, planes, trends, decisions asked twice."""

from __future__ import annotations

import re
import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from rtid.daemon.acceptance import taken
from rtid.daemon.calendar import TrendLine
from rtid.daemon.chronicle import FILE, Chronicle
from rtid.daemon.status import Alarm, BlockPlane, EdgeHealth, Scope, SignalHealth, write
from rtid.ui.live_page import Live, Question
from rtid.ui.live_scope import KEPT_S, SLIDE_S, Recent, trends
from tests.ui.test_live_page import NOW, status

SIGNALS = tuple(
    SignalHealth(name, kind, unit, "m")
    for name, kind, unit in (
        ("u", "command", "V"), ("p_a", "pressure", "Pa"), ("p_s", "pressure", "Pa"),
        ("x", "position", "m"),
    )
)  # fmt: skip
PLANE = BlockPlane((0.0, 1.0, 2.0), (0.0, 1e6, 4e6), "vl..", "u", "p_s", "p_a")


def second(t_s: float) -> Scope:
    """A second at u = 1.5 V and 3 MPa of pressure drop."""
    values = {"u": 1.5, "p_a": 1e6, "p_s": 4e6, "x": 0.1}
    bins = tuple(t_s + 0.1 * k for k in range(10))
    return Scope(
        bins,
        {n: (v,) * 10 for n, v in values.items()},
        {n: (1.01 * v,) * 10 for n, v in values.items()},
    )


def test_the_last_minute_is_drawn_at_ten_values_a_second() -> None:
    recent = Recent()
    for k in range(90):
        recent.take(second(float(k)))
        recent.take(second(float(k)))  # told twice
    assert abs(len(recent) - 10 * (KEPT_S + SLIDE_S)) <= 2
    drawn = recent.scopes(SIGNALS)
    assert drawn.count("<svg") == 3 and drawn.count("<polygon") == 4
    assert drawn.count('<g class="slide">') == 3
    points = re.findall(r'points="([^"]+)"', drawn)[0].split()
    assert len(points) == 2 * len(recent)
    first, last = (float(points[k].split(",")[0]) for k in (0, len(recent) - 1))
    assert last == pytest.approx(610.0) and first == pytest.approx(0.0, abs=1.0)  # a second to come
    recent.take(second(3.0))  # the daemon was started again
    assert len(recent) == 10


def test_a_plane_shows_its_blocks_and_where_the_machine_is() -> None:
    recent, edge = Recent(), EdgeHealth("pa", plane=PLANE)
    recent.take(second(0.0))
    drawn = recent.plane(edge)
    valid, learning = re.findall(r'<path d="([^"]+)" fill="var\(--(?:bar|open)\)"', drawn)
    assert valid == "M0.0,90.0H90.0V120.0H0.0Z"
    assert learning == "M0.0,0.0H90.0V90.0H0.0Z"
    assert drawn.count("<circle") == 10
    x, y = re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', drawn)[0]
    assert float(x) == pytest.approx(180 * 1.5 / 2, rel=0.02)
    assert float(y) == pytest.approx(120 * (4 - 3) / 4, rel=0.02)
    assert recent.plane(EdgeHealth("pa")) == ""


def test_trends_have_their_bands() -> None:
    beta = TrendLine("bulk modulus a", "Pa", ((0.0, 1e9, 1e7), (7200.0, 9e8, 1e7)))
    drawn = trends([beta, TrendLine("bulk modulus b", "Pa", ())])
    assert drawn.count("<svg") == 1 and drawn.count("<polygon") == 2  # a band and its middle
    assert "2 h" in drawn and "bulk modulus a 900.0 ± 19.6 MPa" in drawn
    polygons = re.findall(r'points="([^"]+)"', drawn)
    wide, thin = (re.findall(r"-?[\d.]+,([\d.]+)", points) for points in polygons)
    assert float(wide[3]) - float(wide[0]) > 5 * (float(thin[3]) - float(thin[0]))
    assert trends([]) == ""


def test_a_value_that_was_hardly_known_does_not_flatten_a_trend() -> None:
    points = [(60.0 * k, 1e9, 1e6) for k in range(1, 10)]
    drawn = trends([TrendLine("bulk modulus a", "Pa", ((0.0, 5e9, 1e12), *points))])
    assert "997.8 to 1002, 0.15 h" in drawn


def test_every_kind_has_a_trend_of_its_own_and_a_gap_is_a_gap() -> None:
    every = [(60.0 * k, 5e-3, 1e-4) for k in range(10)]
    later = [(t + 3600.0, v, sd) for t, v, sd in every]
    lag = TrendLine("spool lag", "s", (*every[:4], *later))
    leaks = [TrendLine(f"leak {where}", "m3/s/Pa", tuple(every)) for where in ("a-b", "b-t")]
    drawn = trends([lag, *leaks])
    assert drawn.count("<svg") == 2 and "spool lag 5.00 ± 0.20 ms" in drawn
    of_lag, of_leaks = drawn.split("</svg>")[:2]
    assert of_lag.count("<polygon") == 4 and of_leaks.count("<polygon") == 4
    middle = re.findall(r'points="([^"]+)"', of_lag)[1].split()
    assert float(middle[3].split(",")[0]) < 40.0  # three minutes of 69


def test_the_history_is_shown_and_compared(tmp_path: Path) -> None:
    write(tmp_path, status())
    Chronicle(tmp_path).close()
    with closing(sqlite3.connect(tmp_path / FILE)) as base:
        for hours in (60.0, 40.0, 20.0, 1.0):
            row = (NOW - 3600.0 * hours, "a", 1e9 - 1e6 * hours, 1e6)
            base.execute("INSERT INTO estimate VALUES (?, ?, ?, ?)", row)
        base.commit()
    live = Live(tmp_path, lambda: NOW, lambda do: do())
    live.compare("1")
    health = live.fragments()["live_health"]
    assert "Trends" in health and "bulk modulus a MPa" in health
    live.compare("30")
    assert 'data-name="30" id="days_2" aria-pressed="true"' in live.fragments()["live_health"]


def test_a_changed_machine_is_accepted_when_it_is_meant(tmp_path: Path) -> None:
    changed = Alarm("plant_changed", "the map foretells no more", NOW - 9, None, "plant", "seconds")
    write(tmp_path, replace(status(), alarms=(changed,)))
    live = Live(tmp_path, lambda: NOW)
    health = live.fragments()["live_health"]
    since = time.strftime("%H:%M:%S", time.localtime(NOW - 9))
    assert f"since {since}, for 9.0 s" in health and 'data-do="look"' in health
    assert 'data-do="accept"' in health and 'data-do="sure"' not in health
    assert taken(tmp_path) is None
    asked = live.fragments(Question("accept", "<p>Really?</p>"))["live_health"]
    assert '<p>Really?</p><button class="main" data-do="sure" data-name="accept">' in asked
    refused = live.fragments(Question("apply", "", may_go=False))["live_health"]
    assert 'data-do="sure"' not in refused and 'data-do="not_sure"' in refused
    assert live.accept().startswith("asked")
    request = taken(tmp_path)
    assert request is not None and request.reason == "on the page"
    write(tmp_path, status())
    quiet = Live(tmp_path, lambda: NOW)
    quiet.fragments()
    assert quiet.accept().startswith("nothing") and taken(tmp_path) is None


def test_a_follower_cannot_decide(tmp_path: Path) -> None:
    changed = Alarm("plant_changed", "the map foretells no more", NOW - 9, None, "plant")
    write(tmp_path, replace(status(), alarms=(changed,)))
    live = Live(tmp_path, lambda: NOW)
    for asking in (None, Question("apply", "")):
        shown = live.fragments(asking, follows=True)["live_health"]
        buttons = re.findall(r'<button [^>]*data-do="(?:accept|apply|sure|not_sure)"[^>]*>', shown)
        assert len(buttons) == 2 and all(" disabled" in button for button in buttons)
        shown = live.fragments(asking)["live_health"]
        assert " disabled" not in "".join(re.findall(r"<button [^>]*data-do[^>]*>", shown))


def test_what_alarms_again_and_again_takes_one_line_with_the_seconds_of_each(
    tmp_path: Path,
) -> None:
    often = tuple(
        Alarm("overload", f"{k} ticks", NOW - 60 * k, NOW - 60 * k + 5, "loop", f"seconds {k}")
        for k in range(1, 31)
    )
    silent = Alarm("message_silent", "no Pressures", NOW - 1, None)
    write(tmp_path, replace(status(), alarms=(silent, *often)))
    health = Live(tmp_path, lambda: NOW).fragments()["live_health"]
    oldest = time.strftime("%H:%M:%S", time.localtime(NOW - 1800))
    assert health.count("<b>overload</b>") == 1 and f"30 times since {oldest}" in health
    assert "<b>message_silent</b>" in health and 'data-name="seconds 2"' in health
