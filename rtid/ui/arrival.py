"""The door of the page: a file, its signals and their roles, the cylinder, verdict, project.

What `rtid quick` does, for whoever has no project file yet; saved, the page goes on with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rtid.errors import RtidError
from rtid.tell.html import button, text
from rtid.ui.curves import spark, spoken
from rtid.ui.upload import DATABASES, is_welcome

if TYPE_CHECKING:
    from rtid.study.quick_machine import Given
    from rtid.trace.glance import Curve, Glance
    from rtid.ui.desk import Judged
    from rtid.ui.shared import Session

MOST_FILES = 30  # of the folder, the newest
ROLES = {
    "u": "command of the valves",
    "x": "position of the piston",
    "p_a": "pressure of the chamber that grows with x",
    "p_b": "pressure of the other chamber",
    "p_supply": "supply pressure",
    "p_tank": "tank pressure",
    "v": "speed of the piston",
}
SIZES = {  # words, unit, SI per unit
    "bore": ("bore", "mm", 1e-3),
    "rod": ("rod", "mm", 1e-3),
    "stroke": ("stroke", "mm", 1e-3),
    "dead_a": ("dead volume of A, with hoses", "L", 1e-3),
    "dead_b": ("dead volume of B, with hoses", "L", 1e-3),
    "safe_band": ("valves shut up to", "as the command", 1.0),
    "lag": ("lag of the spools", "ms", 1e-3),
    "supply": ("supply, if not measured", "MPa", 1e6),
}
SHELL = """<div class="arrival"><div><section><h2>File</h2><div id="arrival_files"></div></section>
<section><h2>Signals</h2><div id="arrival_signals"></div></section></div>
<div><section><h2>Verdict</h2><div id="arrival_told"></div></section><section><h2>Cylinder</h2>
<div id="arrival_sizes"></div><div id="arrival_drawing"></div></section></div></div>"""


@dataclass
class Arrival:
    """What is known of a file without a project; sizes: in SI, by their names in SIZES."""

    folder: Path
    file: Path | None = None
    more: tuple[Path, ...] = ()  # further records of the same project
    dbc: Path | None = None
    seen: Glance | None = None
    roles: dict[str, str] = field(default_factory=dict)
    role: str = "u"  # that the next click on a curve gives
    sizes: dict[str, float] = field(default_factory=dict)
    judged: Judged | None = None

    def files(self) -> list[Path]:
        """The newest files of the folder that can be looked at."""
        paths = [p for p in self.folder.iterdir() if p.is_file() and is_welcome(p.name)]
        return sorted(paths, key=lambda p: -p.stat().st_mtime)[:MOST_FILES]

    def take(self, path: Path) -> None:
        """Look at a file from now on, or read logs with a database."""
        if path.suffix.lower() in DATABASES:
            self.dbc = None if path == self.dbc else path
        else:
            self.more = self.more if path == self.file else ()
            self.file = path
        self.seen, self.judged, self.roles = None, None, {}

    @property
    def can_be_judged(self) -> bool:
        """Command and position are known; without pressures what is moved is found with them."""
        roles = self.roles.keys()
        return "u" in roles and ("x" in roles or not {"p_a", "p_b"} & roles)

    def give(self, name: str) -> None:
        """Let a signal play the role that is next, and no other."""
        self.roles = {r: n for r, n in self.roles.items() if n != name} | {self.role: name}
        self.role = next((r for r in ROLES if r not in self.roles), self.role)
        self.judged = None

    def measure(self, name: str, typed: str) -> None:
        """Note a size as typed, "" for none.  RtidError where it is no size."""
        self.judged = None
        self.sizes.pop(name, None)
        if typed.strip() and name in SIZES:
            self.sizes[name] = _number(name, typed) * SIZES[name][2]

    def given(self) -> Given:
        """The sizes as `rtid quick` takes them."""
        from rtid.study.quick_machine import Given  # noqa: PLC0415 - the live page needs none

        known = self.sizes
        ends = [known[k] for k in ("dead_a", "dead_b") if k in known]
        volumes = (ends[0], ends[-1]) if ends else None
        return Given(
            known.get("bore"), known.get("rod"), known.get("stroke"), volumes,
            known.get("safe_band"), known.get("lag"), known.get("supply"),
        )  # fmt: skip


def _number(name: str, typed: str) -> float:
    with suppress(ValueError):
        value = float(typed.replace(",", "."))
        if math.isfinite(value) and value > 0.0:
            return value
    raise RtidError(f"{SIZES[name][0]}: {typed!r} is no size", f"a number, {SIZES[name][1]}")


def choose(session: Session, arrival: Arrival, path: Path) -> None:
    """Open a file, and judge it at once where its signals have roles."""
    arrival.take(path)
    if arrival.file is None:
        session.tell("state")
        return

    def seen(result: Glance) -> None:
        arrival.seen, arrival.roles = result, dict(result.roles)
        arrival.role = next((r for r in ROLES if r not in arrival.roles), "u")
        session.tell("state")
        if arrival.can_be_judged:
            judge(session, arrival)

    session.ask("glance", arrival.file, arrival.dbc, then=seen)


def judge(session: Session, arrival: Arrival) -> None:
    """Ask for the verdict of the file with what is known."""
    if arrival.file is None:
        return
    proposed = arrival.seen.roles if arrival.seen else {}
    chosen = {r: n for r, n in arrival.roles.items() if proposed.get(r) != n}

    def judged(result: Judged) -> None:
        arrival.judged = result
        session.tell("state")

    known = arrival.file, arrival.dbc, arrival.given(), chosen, arrival.more
    session.ask("judge", *known, then=judged)


def asked(session: Session, arrival: Arrival, asked: dict[str, str]) -> None:
    """What a user does here."""
    what, name = asked.get("do", ""), asked.get("name", "")
    try:
        if what == "file" and (path := arrival.folder / Path(name).name).is_file():
            choose(session, arrival, path)
        elif what == "role" and name in ROLES:
            arrival.role = name
        elif what == "curve" and arrival.seen and name in {c.name for c in arrival.seen.curves}:
            arrival.give(name)
        elif what == "size":
            arrival.measure(asked.get("size", ""), name)
        elif what == "judge":
            judge(session, arrival)
        elif what == "keep" and (judged := arrival.judged) and judged.project and arrival.file:
            session.begin(judged.project, judged.text, arrival.file)
    except RtidError as error:
        session.trouble = str(error), error.remedy
    session.tell("state")


DOES: dict[str, Callable[[Session, Arrival, dict[str, str]], None]] = dict.fromkeys(
    ("file", "role", "curve", "size", "judge", "keep"), asked
)


def fragments(session: Session, arrival: Arrival) -> dict[str, str]:
    """HTML by place, the frame first."""
    return {
        "cover": SHELL,
        "arrival_files": _files(arrival),
        "arrival_signals": _signals(arrival),
        "arrival_sizes": _sizes(),
        "arrival_drawing": drawing(arrival.sizes),
        "arrival_told": _told(session, arrival),
    }


def _files(arrival: Arrival) -> str:
    chosen = (arrival.file, arrival.dbc, *arrival.more)
    rows = "".join(
        f'<button data-do="file" data-name="{text(p.name)}" '
        f'aria-pressed="{str(p in chosen).lower()}">{text(p.name)}</button> '
        for p in arrival.files()
    )
    return (
        "<p>Drop a log (.blf .asc .log .trc .mf4), a table (.csv .parquet .mat) or the database of "
        'a bus (.dbc .eds) on this page, <label class="link">choose one<input type="file" '
        'id="arrival_file" data-upload="yes"></label>, or take one of this folder:</p>'
        f'<div class="choices">{rows or "There is none."}</div>'
    )  # fmt: skip


def _signals(arrival: Arrival) -> str:
    if arrival.seen is None:
        return "<p>What is in the file, with small curves.</p>"
    played = {name: role for role, name in arrival.roles.items()}
    chips = "".join(
        f'<button data-do="role" data-name="{role}" title="{words}" '
        f'aria-pressed="{str(role == arrival.role).lower()}"><b>{role}</b> '
        f"{text(arrival.roles.get(role, 'none'))}</button> "
        for role, words in ROLES.items()
    )
    curves = "".join(_curve(c, played.get(c.name, "")) for c in arrival.seen.curves)
    more = f"<p>{arrival.seen.left_out} more are not shown.</p>" if arrival.seen.left_out else ""
    said = f"<b>{arrival.role}</b>, the {ROLES[arrival.role]}: click the curve that is it."
    return (
        f'<div class="choices">{chips}</div><p>{said}</p><div class="curves">{curves}</div>{more}'
    )


def _curve(curve: Curve, role: str) -> str:
    low, high, unit = spoken(curve)
    words = f"{low:.3g} to {high:.3g} {unit or '(no unit)'}"
    return (
        f'<button class="curve" data-do="curve" data-name="{text(curve.name)}" '
        f'aria-pressed="{str(bool(role)).lower()}"><span><b>{text(curve.name)}</b>'
        f"{f' = {role}' if role else ''}</span>{spark(curve.low, curve.high)}"
        f"<span>{text(words)}</span></button>"
    )


def _sizes() -> str:
    """The form; it stays as it is while somebody types."""
    rows = "".join(
        f'<label for="size_{name}">{words}</label><span><input id="size_{name}" data-do="size" '
        f'data-size="{name}" inputmode="decimal" size="7" autocomplete="off"> {unit}</span>'
        for name, (words, unit, _) in SIZES.items()
    )
    return f'<div class="sizes">{rows}</div><p>What is left empty is assumed, and said.</p>'


def drawing(sizes: dict[str, float]) -> str:
    """The cylinder, to scale as far as it is known."""
    bore = sizes.get("bore", 0.05)
    rod, stroke = sizes.get("rod", 0.7 * bore), sizes.get("stroke", 0.5)
    if rod >= bore:
        return '<p class="bad">The rod is not thinner than the bore.</p>'
    tall = min(max(300.0 * bore / stroke, 44.0), 90.0)
    thin, top = tall * rod / bore, 60.0 - tall / 2
    areas = [math.pi / 4 * 1e4 * a for a in (bore**2, bore**2 - rod**2)]
    shown = [
        f"{words} {1e3 * value:g} mm{'' if words in sizes else '?'}"
        for words, value in (("bore", bore), ("rod", rod), ("stroke", stroke))
    ]
    return (
        '<svg class="cylinder" viewBox="0 0 330 132" role="img" aria-label="'
        f'{", ".join(shown)}"><rect x="20" y="{top:.1f}" width="200" height="{tall:.1f}"/>'
        f'<rect class="rod" x="112" y="{60 - thin / 2:.1f}" width="198" height="{thin:.1f}"/>'
        f'<rect class="piston" x="100" y="{top:.1f}" width="12" height="{tall:.1f}"/>'
        f'<text x="60" y="64">A</text><text x="160" y="{top - 4:.1f}">B</text>'
        f'<text x="60" y="126">A {areas[0]:.3g} cm²</text>'
        f'<text x="165" y="126">B {areas[1]:.3g} cm²</text></svg><p>{", ".join(shown)}</p>'
    )


def _told(session: Session, arrival: Arrival) -> str:
    if arrival.seen is None:
        return "<p>What is missing in the model, and whether the data is good enough.</p>"
    if session.worker.is_busy:
        return f"<p>{text(session.doing or 'working')} ...</p>"
    again = button("Judge", "judge", kind="" if arrival.judged else "main")
    if arrival.judged is None:
        return f"{again}<p>Roles and sizes have changed, or a role is missing.</p>"
    judged = arrival.judged
    lines, keep = text("\n".join(judged.lines)), ""
    if judged.project:
        keep = button(f"Save {judged.project.name} and open", "keep", kind="main")
    return f'<h3 class="{judged.kind}">{text(judged.heading)}</h3>{keep} {again}<pre>{lines}</pre>'
