"""The live page from a status: every part says what it knows, stale is said to be stale."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rtid.cli.main import build
from rtid.daemon import calendar
from rtid.daemon.calendar import TrendLine
from rtid.daemon.chronicle import Chronicle
from rtid.daemon.status import (
    Advice,
    Alarm,
    BusHealth,
    ChamberStatus,
    Distribution,
    EdgeHealth,
    EffectStatus,
    EstimateStatus,
    LoopHealth,
    MessageHealth,
    Scope,
    SignalHealth,
    Status,
    Store,
    Verdict,
    write,
)
from rtid.daemon.wording import plant_changed
from rtid.ui import live_page
from rtid.ui.live_page import Live
from rtid.ui.live_scope import trends

NOW = 1_800_000_000.0


def status() -> Status:
    work = Distribution(3, 100.0, 200.0, 400.0, 900.0, (0.0, 100.0, 200.0, 1000.0), (5, 20, 1))
    timing = {"rate_hz": 998.0, "age_s": 0.001, "gap_s": 0.004}
    pressure = SignalHealth("p_a", "pressure", "Pa", "Pressures", 2.5e6, 1e6, 3e6, 998.0)
    position = SignalHealth("x", "position", "m", "Motion", 0.1, 0.1, 0.1, verdict="frozen")
    message = MessageHealth("Pressures", 0x101, 1000.0, **timing, verdict="ok", refused={"crc": 7})
    estimate = EstimateStatus(
        state="learning",
        stale=False,
        samples=60_000,
        rho=1.05,
        chambers=(ChamberStatus("a", 1.06e9, 1e6),),
        edges=(EdgeHealth("pa", {"valid": 30, "learning": 12}, {}, 0.7),),
        refused={"range": 3, "samples": 60_000},
    )
    return Status(
        name="press <1>",
        pid=1,
        started_unix_s=NOW - 60,
        now_unix_s=NOW,
        loop=LoopHealth(1000.0, 60_000, 3, 0, {"late": 3}, work, work, work, work),
        bus=BusHealth("socketcan", "can0", "open", 180_000, 3000.0, 0, 0, {"error_frame": 2}),
        messages=(message,),
        signals=(replace(pressure, verdict="ok"), position),
        estimate=estimate,
        store=Store("NOT SAVED", "disk full", 40.0),
        advice=Advice(NOW - 3, "Valve <pa> knows least"),
        verdict=Verdict(NOW - 5, "missing", "Internal leakage at a-b"),
        alarms=(Alarm("frozen", "x does not move", NOW - 3, None, "sensor"),),
    )


def shown(folder: Path, at: float = NOW + 0.5) -> str:
    return "".join(Live(folder, lambda: at).fragments().values())


def test_everything_that_the_daemon_says_is_there(tmp_path: Path) -> None:
    write(tmp_path, status())
    html = shown(tmp_path)
    for words in (
        *("press &lt;1&gt;", "can0 is open", "3000 frames/s", "error frame 2", "NOT SAVED"),
        *("disk full", "1000 Hz", "3 overruns (late 3)", "2.5 MPa", "frozen", "crc 7", "0x101"),
        *("998 /s", "1060.0 ± 2.0 MPa", "30 of 42 visited blocks valid", "range 3"),
        *("Internal leakage at a-b", "x does not move", "To learn more", "Valve &lt;pa&gt;"),
    ):
        assert words in html, words
    assert "samples 60,000" not in html  # counted, not refused
    assert "stale:" not in html


def test_an_alarm_that_is_over_leaves_nothing_to_be_decided(tmp_path: Path) -> None:
    """It told to accept the machine, beside a button that could not be pressed."""
    changed = plant_changed(Verdict(NOW - 5, "missing", "A leak."))
    for until, is_asked in ((None, True), (NOW - 1, False)):
        alarm = Alarm("plant_changed", changed, NOW - 9, until, "plant")
        write(tmp_path, replace(status(), alarms=(alarm,)))
        assert "A leak." in (html := shown(tmp_path)) and ("rtid accept" in html) is is_asked
        said = CliRunner().invoke(build(["status"]), ["status", str(tmp_path)]).output
        assert ("rtid accept" in " ".join(said.split())) is is_asked


def test_effects_and_borders_are_in_words_of_the_workshop(tmp_path: Path) -> None:
    effect = EffectStatus("extra_dead_volume a", 2.66e-4, 2e-6, "m3")
    estimate = replace(status().estimate, effects=(effect,))
    write(tmp_path, replace(status(), estimate=estimate))
    assert "<dt>extra dead volume a</dt><dd>0.266" in shown(tmp_path)
    points = ((NOW - 60.0, 2.6e-4, 2e-6), (NOW, 2.66e-4, 2e-6))
    assert "extra dead volume a 0.266" in trends([TrendLine(effect.name, "m3", points)])


def test_a_status_that_is_not_renewed_is_stale(tmp_path: Path) -> None:
    write(tmp_path, status())
    html = shown(tmp_path, NOW + 12.0)
    assert "stale: 12 s old" in html
    assert 'class="stale"' in html


def test_the_newest_status_is_read_and_an_old_one_kept_where_the_file_is_torn(
    tmp_path: Path,
) -> None:
    live = Live(tmp_path, lambda: NOW)
    assert "No daemon has been heard" in live.fragments()["live_health"]
    write(tmp_path, status())
    assert "3000 frames/s" in live.fragments()["live_health"]
    write(tmp_path, replace(status(), bus=BusHealth("socketcan", "can0", "open", 1, 2500.0)))
    assert "2500 frames/s" in live.fragments()["live_health"]
    (tmp_path / "status.json").write_text("{torn")
    assert "2500 frames/s" in live.fragments()["live_health"]


@pytest.mark.parametrize("edges", [(), (0.0, 1.0), (0.0, 100.0, 1000.0)])
def test_a_histogram_of_nothing_is_no_picture(tmp_path: Path, edges: tuple[float, ...]) -> None:
    empty = Distribution(0, edges_us=edges, counts=(0,) * max(0, len(edges) - 1))
    write(tmp_path, replace(status(), loop=LoopHealth(1000.0, work=empty)))
    assert "<svg" not in shown(tmp_path)


def test_a_long_history_is_read_beside_whoever_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop that serves all pages does not wait for it, and it is read once at a time."""
    write(tmp_path, status())
    Chronicle(tmp_path).close()
    may_go, begun = threading.Event(), list[str]()

    def slowly(*_: object) -> list[calendar.TrendLine]:
        begun.append(threading.current_thread().name)
        assert may_go.wait(30.0)
        return [calendar.TrendLine("spool lag", "s", ((0.0, 5e-3, 1e-4), (60.0, 5e-3, 1e-4)))]

    monkeypatch.setattr(live_page, "trend", slowly)
    at = [NOW]
    live = Live(tmp_path, lambda: at[0])
    for _ in range(5):
        assert "spool lag" not in live.fragments()["live_health"]
        at[0] += 60.0
    assert begun == ["rtid-history"]
    may_go.set()
    end_s = time.monotonic() + 30.0
    while "spool lag 5.00" not in live.fragments()["live_health"]:
        assert time.monotonic() < end_s


def test_what_moves_is_sent_once_for_every_status(tmp_path: Path) -> None:
    """The page looks five times a second; ages are those of whole seconds."""
    bins = tuple(NOW - 60 + 0.1 * k for k in range(10))
    scope = Scope(bins, {"p_a": (1e6,) * 10}, {"p_a": (2e6,) * 10})
    write(tmp_path, replace(status(), scope=scope))
    at = [NOW]
    live = Live(tmp_path, lambda: at[0], lambda do: None)
    first = live.fragments()
    at[0] += 0.8
    assert live.fragments() == first
    at[0] += 0.3
    later = live.fragments()
    assert "<polygon" in first["live_scope"] and later["live_scope"] == first["live_scope"]
    assert later["live_health"] != first["live_health"] and "<polygon" not in first["live_health"]
