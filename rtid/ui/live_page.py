"""Live: what the daemon says of itself, and what to do so that it learns more.

The daemon replaces one small file each second; this page reads it and never talks to the daemon, so
that nothing that is looked at can disturb the loop.  What is older than a few seconds is shown as
stale.
"""

from __future__ import annotations

import getpass
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import floor, log10
from pathlib import Path

from rtid.daemon.acceptance import Acceptance, ask
from rtid.daemon.calendar import calendar_table, notes, side_by_side, trend, two_spans
from rtid.daemon.status import (
    Advice,
    Alarm,
    Distribution,
    EdgeHealth,
    MessageHealth,
    SignalHealth,
    Status,
    StatusError,
    read,
)
from rtid.errors import RtidError
from rtid.tell.html import button, choice, table, text
from rtid.tell.words import VERDICTS
from rtid.ui.live_scope import Recent, trends
from rtid.units import scale_of

STALE_S = 3.0
HISTORY_S = 10.0  # between looks at the history
TREND_S = 24 * 3600.0
DAYS = ("1", "7", "30")
CHANGED = "plant_changed"
MOST_ALARMS = 6
COUNTED = ("samples", "rows", "block_changes")
DOTS = {"ok": "ok", "open": "ok", "late": "warn", "reopening": "warn", "suspended": "warn"}
Clock = Callable[[], float]
Do = Callable[[], None]


def beside(do: Do) -> None:
    """In a thread of its own, which ends with it."""
    threading.Thread(target=do, name="rtid-history", daemon=True).start()


@dataclass(frozen=True)
class Question:
    """What the user has to confirm: of what, in HTML, and whether yes may be said."""

    about: str
    html: str
    may_go: bool = True


class Live:
    """The status of a daemon that keeps its state in a folder; None: there is none.

    aside: does what takes long, beside whoever asks.
    """

    def __init__(
        self, folder: Path | None, clock: Clock = time.time, aside: Callable[[Do], None] = beside
    ) -> None:
        self._folder, self._clock, self._aside = folder, clock, aside
        self._status: Status | None = None
        self._trouble = ""
        self._stamp = -1
        self._recent, self._instruments = Recent(), ("", "")
        self._history, self._history_s, self._is_reading = "", -HISTORY_S, False
        self.days = DAYS[1]

    def fragments(self, asking: Question | None = None, follows: bool = False) -> dict[str, str]:
        """HTML by place, from the newest status; follows: another browser decides."""
        self.hear()
        status = self._status
        if status is None:
            empty = dict.fromkeys(("live_scope", "live_planes", "live_learning"), "")
            return empty | {"live_health": _nothing(self._trouble)}
        age_s = max(0.0, floor(self._clock() - status.now_unix_s))  # sent anew once a second
        health = _head(status, age_s) + _alarms(status, status.now_unix_s + age_s)
        health += _decisions(status, asking, follows) + self._trends() + _loop(status)
        health += _signals(status.signals) + _messages(status.messages)
        learning = _learning(status) + _coach(status.advice) + _verdict(status)
        scope, planes = self._instruments
        css = "stale" if age_s >= STALE_S else ""
        shown = {"scope": scope, "planes": planes, "health": health, "learning": learning}
        return {
            f"live_{place}": f'<div class="{css}">{html}</div>' if html else ""
            for place, html in shown.items()
        }

    def accept(self) -> str:
        """Take the changed machine for the new normal; what came of it, in words."""
        if self._folder is None or self._status is None or not self._status.has(CHANGED):
            return "nothing to accept: the machine does what the map says"
        try:
            ask(self._folder, Acceptance(self._clock(), getpass.getuser(), "on the page"))
        except OSError as error:
            return f"{self._folder}: {error.strerror}"
        return "asked the daemon to accept the changed machine"

    def compare(self, days: str) -> None:
        """How many days are held beside as many before."""
        if days in DAYS:
            self.days, self._history_s = days, -HISTORY_S

    def _trends(self) -> str:
        """From the daemon's history, looked at now and then."""
        now_s, folder = self._clock(), self._folder
        if folder and not self._is_reading and now_s - self._history_s >= HISTORY_S:
            self._is_reading, self._history_s = True, now_s
            self._aside(lambda: self._look_back(folder, self.days, now_s))
        return self._history

    def _look_back(self, folder: Path, days: str, now_s: float) -> None:
        """A month of estimates takes a while."""
        try:
            self._history = _history(folder, days, now_s)
        except RtidError:
            self._history = ""  # none is written yet
        finally:
            self._is_reading = False

    def hear(self) -> None:
        """Take the newest status, where there is another one."""
        if self._folder is None:
            self._trouble = "no state folder was named"
            return
        try:
            stamp = (self._folder / "status.json").stat().st_mtime_ns
            if stamp != self._stamp:
                self._status, self._stamp = read(self._folder), stamp
                self._recent.take(self._status.scope)
                self._instruments = self._drawn(self._status)
        except StatusError as error:
            self._trouble = str(error)
        except OSError as error:
            self._trouble = f"{self._folder / 'status.json'}: {error.strerror}"

    def _drawn(self, status: Status) -> tuple[str, str]:
        """Scope and planes, once for every status: they are most of what is sent."""
        planes = "".join(self._recent.plane(edge) for edge in status.estimate.edges)
        return self._recent.scopes(status.signals), planes and f'<div class="udp">{planes}</div>'


def _history(folder: Path, days: str, now_s: float) -> str:
    """Trends and calendar.  Raises RtidError where there is no history."""
    lines = trend(folder, now_s - TREND_S)
    before, now = two_spans(float(days), now_s)
    told = calendar_table(float(days), side_by_side(folder, before, now))
    cells = [[text(cell) for cell in row] for row in told.rows]
    said = "".join(f"<p>{text(f'{note.who}: {note.text}')}</p>" for note in notes(folder, now))
    return (
        f"<h3>Trends</h3>{trends(lines)}<h3>Calendar</h3><p>The last "
        f"{choice('days', DAYS, days)} days beside as many before.</p>"
        f"{table(told.heads, cells)}{said}"
    )


def _nothing(trouble: str) -> str:
    return (
        '<div class="card"><h2>No daemon has been heard</h2><p>On the machine, <b>rtid run '
        "PROJECT</b> learns from the bus; <b>rtid ui PROJECT --state FOLDER</b> shows it here. "
        "From the desk: <b>ssh -L 5006:127.0.0.1:5006 MACHINE</b>.</p>"
        f'<p class="key">{text(trouble)}</p></div>'
    )


def _dot(word: str) -> str:
    return f'<span class="dot {DOTS.get(word, "fail")}"></span>'


def _ago(age_s: float | None) -> str:
    return "never" if age_s is None else f"{_age(age_s)} ago"


def _age(age_s: float | None) -> str:
    if age_s is None:
        return "never"
    return f"{1e3 * age_s:.0f} ms" if age_s < 1 else f"{age_s:.1f} s"


def _head(status: Status, age_s: float) -> str:
    bus, store = status.bus, status.store
    stale = f'<b class="bad">stale: {age_s:.0f} s old.</b> ' if age_s >= STALE_S else ""
    refused = _counts(bus.refused)
    saved = f"{store.state}{f' {_age(store.age_s)} ago' if store.age_s is not None else ''}"
    kind = "bad" if store.state == "NOT SAVED" else ""
    return (
        f"<h2>{text(status.name)}</h2><p>{stale}{_dot(bus.state)}bus {text(bus.interface)} "
        f"{text(bus.channel)} is {bus.state}, {bus.frames_per_s:.0f} frames/s, {bus.frames:,} in "
        f"all{text(f'; refused: {refused}' if refused else '')}. State: "
        f'<span class="{kind}">{text(f"{saved} {store.reason}".rstrip())}</span>. '
        f"{status.rss_anon_mb:.0f} MB.</p>"
    )


def _refusals(counts: dict[str, int]) -> str:
    """Without what is counted and not refused."""
    return _counts({name: n for name, n in counts.items() if name not in COUNTED})


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {n:,}" for name, n in counts.items() if n)


def _alarms(status: Status, now_s: float) -> str:
    alike: dict[tuple[str, bool], list[Alarm]] = {}
    for alarm in status.alarms:
        alike.setdefault((alarm.name, alarm.is_on), []).append(alarm)
    lines = [_same_alarms(alarms, now_s) for alarms in list(alike.values())[:MOST_ALARMS]]
    shown = "".join(lines) or '<li><span class="dot ok"></span>none</li>'
    return f'<h3>Alarms</h3><ul style="list-style:none;padding:0;margin:0">{shown}</ul>'


def _same_alarms(alarms: Sequence[Alarm], now_s: float) -> str:
    """Alarms of one name, newest first: what the newest says, and the seconds of each."""
    newest, is_on = alarms[0], alarms[0].is_on
    since = _age(max(0.0, now_s - newest.since_unix_s))
    clock = _clock(newest)
    word = f"since {clock}, for {since}" if is_on else f"at {clock}, over"
    if len(alarms) > 1:
        word += f"; {len(alarms)} times since {_clock(alarms[-1])}"
    dot = _dot("failed" if is_on else "ok")
    seconds = "".join(_seconds(alarm, alarm is newest) for alarm in alarms[:MOST_ALARMS])
    return f"<li>{dot}<b>{text(newest.name)}</b> {text(newest.words)} ({word}){seconds}</li>"


def _clock(alarm: Alarm) -> str:
    return time.strftime("%H:%M:%S", time.localtime(alarm.since_unix_s))


def _seconds(alarm: Alarm, is_newest: bool) -> str:
    """A button that opens the recorded seconds around an alarm."""
    if not alarm.trace:
        return ""
    words = "look at its seconds" if is_newest else f"at {_clock(alarm)}"
    return " " + button(words, "look", kind="link", name=alarm.trace)


def _decisions(status: Status, asking: Question | None, follows: bool) -> str:
    """What somebody may decide: to accept a changed machine, to send the maps; twice asked."""
    if asking:
        words = "No" if asking.may_go else "Close"
        no = button(words, "not_sure", off=follows, name=asking.about)
        sure = button("Yes, do it", "sure", kind="main", off=follows, name=asking.about)
        return f'<div class="card">{asking.html}{f"{sure} " if asking.may_go else ""}{no}</div>'
    has_changed = status.has(CHANGED)
    accept = button("Accept the changed machine", "accept", off=follows or not has_changed)
    return f"<p>{accept} {button('Apply the maps', 'apply', off=follows)}</p>"


def _loop(status: Status) -> str:
    loop, deadline_us = status.loop, 1e6 / status.loop.rate_hz
    late, work = loop.lateness_1s, loop.work_1s
    causes = _counts(loop.causes)
    return (
        f"<h3>Loop</h3><p>{loop.rate_hz:g} Hz, {loop.ticks:,} ticks, {loop.overruns:,} overruns"
        f"{text(f' ({causes})' if causes else '')}, scheduling {text(loop.scheduling)}. Last "
        f"second: work p99 {work.p99_us:.0f} us, lateness p99 {late.p99_us:.0f} us.</p>"
        f"{_histogram(loop.work, deadline_us)}"
        '<p class="key">Work per tick since the start, decades of counts; the dashed line is the '
        "deadline.</p>"
    )


def _histogram(distribution: Distribution, deadline_us: float) -> str:
    """Counts by duration, both logarithmic, with the deadline."""
    bins = [
        (low, high, n)
        for low, high, n in zip(
            distribution.edges_us, distribution.edges_us[1:], distribution.counts, strict=False
        )
        if n and high > 0
    ]
    if not bins:
        return ""
    low = log10(max(0.5, min(b[0] or b[1] / 2 for b in bins)))
    high = log10(max(2 * deadline_us, *(b[1] for b in bins)))
    top = log10(10 * max(b[2] for b in bins))

    def x(us: float) -> float:
        return 440 * (log10(max(us, 10**low)) - low) / (high - low)

    bars = "".join(
        f'<rect x="{x(a):.1f}" width="{max(1.0, x(b) - x(a) - 0.6):.1f}" '
        f'y="{52 - 50 * log10(10 * n) / top:.1f}" height="{50 * log10(10 * n) / top:.1f}"/>'
        for a, b, n in bins
    )
    ticks = "".join(
        f'<text x="{x(10.0**k):.0f}" y="66" font-size="10">{_duration(10.0**k)}</text>'
        for k in range(int(low), int(high) + 1)
        if 10.0**k >= 10**low
    )
    return (
        '<svg viewBox="0 0 490 70" width="490" role="img" '
        'aria-label="histogram of the work per tick" '
        f'style="max-width:100%"><g fill="var(--bar)">{bars}</g><line x1="{x(deadline_us):.1f}" '
        f'x2="{x(deadline_us):.1f}" y1="0" y2="54" stroke="var(--found)" stroke-dasharray="4 3"/>'
        f'<g fill="var(--quiet)">{ticks}</g></svg>'
    )


def _duration(us: float) -> str:
    return f"{us:g} us" if us < 1000 else f"{us / 1000:g} ms"


def _signals(signals: Iterable[SignalHealth]) -> str:
    head = ("signal", "now|", "last second|", "rate|", "age|", "gap|")
    rows = []
    for s in signals:
        scale = scale_of(s.unit)
        span = f"{_value(s.minimum, scale.factor)} to {_value(s.maximum, scale.factor)}"
        rows.append(
            (
                f"{_dot(s.verdict)}{text(s.name)}{_trouble(s.verdict)}",
                text(f"{_value(s.value, scale.factor)} {scale.name}"),
                text(span),
                f"{s.rate_hz:.0f} /s",
                _age(s.age_s),
                f"{1e3 * s.gap_s:.0f} ms",
            )
        )
    return f"<h3>Signals</h3>{table(head, rows)}" if rows else ""


def _trouble(verdict: str) -> str:
    return "" if verdict == "ok" else f' <b class="bad">{text(verdict.replace("_", " "))}</b>'


def _value(value: float | None, factor: float) -> str:
    return "-" if value is None else f"{factor * value:.3g}"


def _messages(messages: Iterable[MessageHealth]) -> str:
    head = ("message", "rate|", "wanted|", "age|", "gap|", "refused (counter, CRC, ...)")
    rows = [
        (
            f"{_dot(m.verdict)}{text(m.name)} 0x{m.can_id:X}",
            f"{m.rate_hz:.0f} /s",
            f"{m.nominal_hz:.0f} /s",
            _age(m.age_s),
            f"{1e3 * m.gap_s:.0f} ms",
            text(_counts(m.refused) or "nothing"),
        )
        for m in messages
    ]
    return f"<h3>Messages</h3>{table(head, rows)}" if rows else ""


def _learning(status: Status) -> str:
    result = status.estimate
    pressure = scale_of("Pa")
    betas = "".join(
        f"<dt>bulk modulus {text(c.name)}</dt><dd>"
        f"{pressure.known(c.beta_pa, c.beta_sd_pa or 0.0, 1)} {pressure.name}</dd>"
        for c in result.chambers
        if c.beta_pa is not None
    )
    betas += "".join(
        f"<dt>{text(e.name.replace('_', ' '))}</dt>"
        f"<dd>{scale.known(e.size, e.sd, 4)} {text(scale.name)}</dd>"
        for e in result.effects
        for scale in (scale_of(e.unit),)
    )
    betas += "<dt>±</dt><dd>95 % interval</dd>" if betas else ""
    stale = ' <b class="open">stale</b>' if result.stale else ""
    rho = (
        ""
        if result.rho is None
        else f"<dt>residual variance</dt><dd>{result.rho:.2f} of noise</dd>"
    )
    refused = _refusals(result.refused)
    bars = "".join(_edge(edge) for edge in result.edges)
    return (
        f"<h2>Learning</h2><p>{_dot('ok' if result.state == 'learning' else 'suspended')}"
        f"{text(result.state)} {text(result.reason)}{stale}</p><dl><dt>samples</dt>"
        f"<dd>{result.samples:,}</dd><dt>newest</dt><dd>{_ago(result.age_s)}</dd>{betas}{rho}"
        f"<dt>refused</dt><dd>{text(refused or 'nothing')}</dd></dl><h3>Blocks</h3>{bars}"
    )


def _edge(edge: EdgeHealth) -> str:
    """How far the blocks of a valve are, as a bar."""
    total = sum(edge.blocks.values())
    valid = edge.blocks.get("valid", 0)
    words = ", ".join(f"{name} {n}" for name, n in edge.blocks.items() if n)
    return (
        f'<div style="display:grid;grid-template-columns:60px 1fr;gap:8px;margin:3px 0"><b>'
        f'{text(edge.name)}</b><div><progress max="1" value="{edge.progress:.3f}" '
        f'style="width:100%;height:9px;accent-color:var(--bar)"></progress><span class="key">'
        f"{valid} of {total} visited blocks valid ({text(words or 'none visited')})</span></div>"
        "</div>"
    )


def _coach(advice: Advice | None) -> str:
    """Which motion fills what is missing, as the daemon's coach has it."""
    if advice is None:
        return ""
    return f'<div class="card"><h2>To learn more</h2>{text(advice.text)}</div>'


def _verdict(status: Status) -> str:
    result = status.verdict
    if result is None:
        words = "is being made" if status.diagnosing else "none yet: it takes a minute of motion"
        return f"<h3>Diagnosis</h3><p>{words}</p>"
    kind, heading = VERDICTS.get(result.verdict, ("open", result.verdict))
    ago = _age(max(0.0, status.now_unix_s - result.at_unix_s))
    return (
        f'<h3>Diagnosis, {ago} ago</h3><div class="card"><h2 class="{kind}">{text(heading)}</h2>'
        f"{text(result.text)}</div>"
    )
