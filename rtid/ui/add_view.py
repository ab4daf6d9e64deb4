"""Add: the error falls. Bars of every revision, what it leaves before and after, undo, history."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from math import isfinite

from bokeh.layouts import column, row
from bokeh.models import UIElement

from rtid.compare import FREE_RUN, BlockRow
from rtid.diagnose.report import Value
from rtid.effects.page import title
from rtid.project.added import AddedSection
from rtid.study.look import Look
from rtid.tell.charts.blocks import Quantity, quantities_of
from rtid.tell.charts.flows import NAMES, flows_of, pressures_of
from rtid.tell.charts.theme import INK_TAG
from rtid.tell.charts.time_plots import TimePlots
from rtid.tell.colours import BLUE, ORANGE
from rtid.tell.html import button, error_bars, table, text
from rtid.tell.words import is_floor, quantity
from rtid.ui.desk_views import Bench
from rtid.ui.headline import undo_button
from rtid.ui.shared import Session, ShownRevision
from rtid.ui.views import PageView
from rtid.units import flow_name


class AddView(PageView):
    """Simulated pressure and residual of the newest revision over those of the one before."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        look, plots = bench.look, bench.time
        self.has_runs = any(part.runs for part in look.parts.values())
        self._before, self._after = _Revised(plots), _Revised(plots)
        rows: list[UIElement] = []
        last = len(look.model.chambers) - 1
        for c, chamber in enumerate(look.model.chambers):
            if self.has_runs:
                title = f"chamber {chamber.name}: pressure, free run"
                made = plots.plot("add", "MPa", title, False)
                self._before.pressures.add(made, f"measured {c}", INK_TAG, 1.4)
                self._before.pressures.add(made, f"model {c}", ORANGE, 1.0)
                self._after.pressures.add(made, f"model {c}", BLUE, 1.0)
                rows.append(row(made, sizing_mode="stretch_both"))
            title = f"chamber {chamber.name}: residual of the flow"
            axis = plots.plot("add", flow_name(), title, c == last)
            self._before.flows.add(axis, f"left {c}", ORANGE, 0.8)
            self._after.flows.add(axis, f"left {c}", BLUE, 0.8)
            rows.append(row(axis, sizing_mode="stretch_both"))
        self.roots = {"plot": column(*rows, sizing_mode="stretch_both")}

    def fragments(self) -> Mapping[str, str]:
        """The bars on the left, the sentence below."""
        return {"bars": bars(self.bench.session), "says": sentence(self.bench.session)}

    def refresh(self) -> None:
        """The newest revision, and the one before it if there is one."""
        revisions = self.bench.session.seen
        after = revisions[-1].look if len(revisions) > 1 else None
        self._before.show(revisions[-2].look if after else revisions[-1].look)
        self._after.show(after)


class _Revised:
    """The lines of one revision."""

    def __init__(self, time: TimePlots) -> None:
        self.pressures, self.flows = (time.lines("add") for _ in range(2))

    def show(self, look: Look | None) -> None:
        """Those of a look; None: nothing."""
        parts = list(look.parts.values()) if look else []
        self.pressures.show(pressures_of(part.runs[FREE_RUN]) for part in parts if part.runs)
        self.flows.show(flows_of(part.equation) for part in parts)


def errors_of(session: Session) -> tuple[list[tuple[str, float, bool]], float]:
    """Name, held-out error in % of the rms flow, and whether it is expected; the sensors' floor.

    The floor is NaN where none is told.
    """
    bars: list[tuple[str, float, bool]] = []
    floor = float("nan")
    for k, revision in enumerate(session.revisions):
        ranked, errors = revision.told, revision.section and revision.section.errors
        value = float("nan")
        if ranked is not None:
            diagnosis = ranked.diagnosis
            value = 100 * diagnosis.heldout_residual_before_m3s / diagnosis.rms_flow_m3s
            floor = 100 * diagnosis.noise_floor_m3s / diagnosis.rms_flow_m3s
        if errors and errors.heldout_pct.after is not None:
            value = errors.heldout_pct.after
            floor = errors.noise_floor_pct or floor
        bars.append((name_of(revision, k), value, False))
    if session.named is not None and session.last and session.last.told:
        diagnosis = session.last.told.diagnosis
        after = 100 * diagnosis.found[0].heldout_residual_after_m3s / diagnosis.rms_flow_m3s
        bars.append((f"+ {title(diagnosis.found[0].effect)}, foretold", after, True))
    return bars, floor if is_floor(floor) else float("nan")


def name_of(revision: ShownRevision, number: int) -> str:
    """What a revision is called."""
    if revision.section is None:
        return "model as it is" if not revision.sections else "model with what the project has"
    sign = "+" if revision.change == "add" else "−"
    return f"{sign} {title(revision.section.effect)} ({revision.section.where})"


def bars(session: Session) -> str:
    """The error of every revision against the sensors' floor, and what can be done."""
    shown, floor = errors_of(session)
    if not any(isfinite(value) for _, value, _ in shown):
        return '<h2>The error of the model</h2><p class="says">It is being measured.</p>'
    dashed = f"; dashed: what the sensors alone leave, {floor:.2f} %" if isfinite(floor) else ""
    return (
        f"<h2>{_heading(session)}</h2>{error_bars(shown, floor)}"
        f'<p class="key">in % of the rms flow{dashed}</p>'
        f"{_actions(session)}{_planes(session)}{_effects(session)}"
        f"{_history(session, shown)}"
    )


def _heading(session: Session) -> str:
    ranked = [r.told for r in session.revisions if r.told]
    if ranked and not ranked[0].diagnosis.held_out_judged:
        return "Error on the motion that taught the model"
    return "Error on motion that the model has not seen"


def _planes(session: Session) -> str:
    """The residual maps before and after the last change, one colour scale."""
    if len(session.seen) < 2 or not session.revisions[-1].is_seen:
        return ""
    looks = [revision.look for revision in session.seen[-2:]]
    part = "validation" if "validation" in looks[0].parts else next(iter(looks[0].parts))
    scale = quantities_of(b for look in looks for b in look.parts[part].blocks)["residual"]
    rows = ""
    for word, look in zip(("before", "after"), looks, strict=True):
        planes = "".join(
            _plane([b for b in look.parts[part].blocks if b.edge == e.name], scale)
            for e in look.model.edges
        )
        rows += f'<div class="key">{word}</div><div class="planes">{planes}</div>'
    return (
        f"<h3>Residual per block, 0 to {scale.high:g} {scale.unit}, on the "
        f'{NAMES.get(part, part)} part</h3><div class="bars">{rows}</div>'
    )


def _plane(blocks: list[BlockRow], scale: Quantity) -> str:
    """One valve's blocks, small."""
    if not blocks:
        return ""
    wide, high = (1 + max(getattr(b, k) for b in blocks) for k in ("i", "j"))
    cells = "".join(
        f'<rect x="{b.i}" y="{high - 1 - b.j}" width="1" height="1" fill="{scale.colour(b)}"/>'
        for b in blocks
    )
    return (
        f'<svg viewBox="0 0 {wide} {high}" preserveAspectRatio="none" role="img" '
        f'aria-label="{escape(blocks[0].edge)}"><title>{text(blocks[0].edge)}</title>{cells}</svg>'
    )


def _actions(session: Session) -> str:
    unsaved = sum(not r.is_saved for r in session.revisions)
    made = ""
    if session.named is not None:
        effect, where = session.named
        made += button(
            f"Add {title(effect).lower()}", "add", kind="main", effect=effect, where=where
        )
    made += " " + undo_button(session.last if len(session.revisions) > 1 else None)
    label = f"Save {unsaved} to the project" if unsaved else "Nothing to save"
    made += " " + button(label, "save", off=not unsaved or session.seen != session.revisions)
    made += " " + button("Write the report", "export", what="report")
    return f"<p>{made}</p>"


def _effects(session: Session) -> str:
    sections = session.last.sections if session.last else ()
    if not sections:
        return ""
    items = "".join(
        f'<div class="card"><b>{text(title(s.effect))}</b> at {text(s.where)}: {_sizes(s)} '
        f"{button('Drop', 'drop', effect=s.effect, where=s.where)}</div>"
        for s in sections
    )
    return f"<h3>In the model, sizes ± 95 %</h3>{items}"


def _sizes(section: AddedSection) -> str:
    return text(
        ", ".join(
            f"{name.replace('_', ' ')} "
            f"{quantity(Value(p.value, p.sd if p.sd is not None else float('nan'), p.unit))}"
            for name, p in section.parameters.items()
        )
    )


def _history(session: Session, shown: list[tuple[str, float, bool]]) -> str:
    rows, before = [], ""
    for k, revision in enumerate(session.revisions):
        name, value, _ = shown[k]
        now = f"{value:.2f} %" if isfinite(value) else ""
        fall = f"{before} → {now}" if before and now else now
        state = "in the project" if revision.is_saved else "not saved"
        rows.append((f"{k}", text(name), text(fall), state))
        before = now
    head = ("", "revision", "held-out error|", "")
    return f"<h3>History of this session</h3>{table(head, rows)}"


def sentence(session: Session) -> str:
    """What the picture says and what to do next."""
    shown, floor = errors_of(session)
    measured = '<b style="color:var(--ink)">—</b> measured'
    if len(session.revisions) > 1:
        before, after = shown[len(session.revisions) - 2][1], shown[len(session.revisions) - 1][1]
        last = session.revisions[-1]
        words = f", the sensors' floor is {floor:.2f} %" if isfinite(floor) else ""
        return (
            f'{measured}, <b style="color:var(--before)">—</b> before the last change, '
            f'<b style="color:var(--bar)">—</b> after it. The error went from {before:.2f} % to '
            f"{after:.2f} %{words}. "
            + ("The project file has it." if last.is_saved else
               "Its pictures follow once its maps are learned." if not last.is_seen else
               "Next: save, or undo; the project file is as it was until you save.")
        )  # fmt: skip
    now = f'{measured}, <b style="color:var(--before)">—</b> the model as it is'
    if session.named is not None:
        return (
            f"{now}. Next: add what the diagnosis names, and see how much of its error goes. "
            "Nothing is written until you save; undo takes it back."
        )
    if session.last is None or session.last.told is None:
        return f"{now}. What is missing is being looked for."
    return (
        f"{now}. The diagnosis names nothing to add; <b>Why</b> has a button to try any effect "
        "all the same."
    )
