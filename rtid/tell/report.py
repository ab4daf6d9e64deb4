"""What `rtid report` tells, as one story per section, and the page and the stills of it."""

from __future__ import annotations

from html import escape

import numpy as np
from matplotlib.figure import Figure

import rtid
from rtid.diagnose.regression import LIMIT_SD
from rtid.diagnose.report import Diagnosis, Value
from rtid.diagnose.trials import GAIN
from rtid.diagnose.verdict import MATERIAL, UNKNOWN
from rtid.effects.page import title
from rtid.project.history import Change, standing
from rtid.tell import stills as still_pictures
from rtid.tell.axes import axes_of
from rtid.tell.charts.dependence import before_and_after
from rtid.tell.charts.maps import maps, slices
from rtid.tell.charts.over_time import flows
from rtid.tell.diagnosed import LIMITS, folded, heading, limits, limits_say, remark, sentences
from rtid.tell.history import history_table
from rtid.tell.html import rendered
from rtid.tell.report_page import embedded, key_figures, page_of
from rtid.tell.report_story import Ranked, ReportStory, sizes_say
from rtid.tell.report_tables import BENT, coverage, parameters, settings
from rtid.tell.story import Bar, Bars, Chart, Planes, Story, StoryPart, Table
from rtid.tell.words import is_floor, named, quantity
from rtid.units import CONVENTION, MPA, flow_name, limit, lpm

NOTHING = "No flow of this record could be judged."
PARTS = "identification part", "held-out part"
RANKED = 16  # candidates that are shown
BEFORE, AFTER = "model as it is", "with what was found"


def page(report_story: ReportStory) -> str:
    """The whole HTML text: one file with its pictures inside, nothing to load."""
    stories = sections(report_story)
    diagnosis = report_story.diagnosed.diagnosis
    head, drawn = embedded(part for story in stories for part in story.parts)
    kind, headline = heading(diagnosis)
    said = Story("", (*sentences(diagnosis), CONVENTION))
    name = report_story.diagnosed.project.sections.project.name
    return page_of(
        head=head,
        title=escape(f"{name}: {report_story.diagnosed.trace.path.name}"),
        kind=kind,
        headline=escape(headline),
        sentences=rendered(said, {}),
        figures=key_figures(_key_figures(report_story)),
        sections="\n".join(rendered(story, drawn) for story in stories),
    )


def stills(report_story: ReportStory) -> dict[str, Figure]:
    """The pictures of the page by name, for `rtid report --png`: no browser is needed."""
    parts = [part for story in sections(report_story) for part in story.parts]
    shown = [part for part in parts if isinstance(part, (Chart, Planes, Bars))]
    return {part.name: still_pictures.draw(part) for part in shown}


def sections(story: ReportStory) -> tuple[Story, ...]:
    """Everything below the verdict."""
    result, axes = story.diagnosed.diagnosis, axes_of(story.diagnosed.model)
    return (
        _errors(story),
        *(Story(chart.title, (chart,)) for chart in story.evidence),
        _flows(story),
        _dependences(story),
        Story(
            "Flow maps",
            (
                maps(story.flowmap, story.points, axes),
                slices(story.flowmap, axes=axes),
                coverage(story),
            ),
        ),
        Story("", (parameters(story),)),
        *([Story("Tracking", (story.tracking,))] if story.tracking else []),
        _ranking(story),
        *_not_found(result, story.ranking),
        *_negligible(story),
        *_history(story.history),
        _provenance(story),
    )


def _share(story: ReportStory, residual_m3s: float) -> float:
    """In per cent of the rms flow."""
    return 100.0 * residual_m3s / story.diagnosed.diagnosis.rms_flow_m3s


def _percent(story: ReportStory, residual_m3s: float) -> str:
    value = _share(story, residual_m3s)
    return f"{value:.2f} %" if np.isfinite(value) else "not known"


def _key_figures(story: ReportStory) -> dict[str, str]:
    """Name and value of what stands in cards below the verdict."""
    diagnosis = story.diagnosed.diagnosis
    before = _percent(story, diagnosis.heldout_residual_before_m3s)
    after = _percent(story, diagnosis.heldout_residual_after_m3s)
    rho = f"{diagnosis.rho_before:.3g}"
    beta = " / ".join(f"{MPA * b:.0f}" for b in diagnosis.beta_pa) + " MPa"
    if diagnosis.verdict == UNKNOWN:
        beta += BENT
    if diagnosis.found:
        before, rho = f"{before} → {after}", f"{rho} → {diagnosis.rho_after:.3g}"
    floor_m3s = diagnosis.noise_floor_m3s
    has_floor = is_floor(floor_m3s, diagnosis.rms_flow_m3s)
    return {
        f"error on the {PARTS[story.judges]}, of the rms flow": before,
        "what the sensors alone leave": _percent(story, floor_m3s) if has_floor else "not known",
        "residual variance, of the noise": rho,
        f"bulk modulus {' / '.join(story.chambers)}": beta,
    }


def _steps(story: ReportStory) -> list[tuple[str, float]]:
    """Error behind each addition, in per cent of the rms flow."""
    result = story.diagnosed.diagnosis
    start = BEFORE if not result.added else "model with what was added before"
    made = [*_saved(story), (start, _share(story, result.heldout_residual_before_m3s))]
    made += [
        (f"+ {named((e.effect, e.where))}", _share(story, e.heldout_residual_after_m3s))
        for e in result.found
    ]
    last = _share(story, result.heldout_residual_after_m3s)
    if result.found and result.negligible and not np.isclose(last, made[-1][1], rtol=0.01):
        made.append(("+ what is present but negligible", last))
    return made


def _saved(story: ReportStory) -> list[tuple[str, float]]:
    """Error before what was added and saved, as its history has it; [] without one."""
    kind = "heldout_pct" if story.judges else "identification_pct"
    alive = standing(story.history)
    before = alive[0].errors.get(kind, {}).get("before") if alive else None
    return [] if before is None else [("before anything was added", float(before))]


def _errors(story: ReportStory) -> Story:
    diagnosis, steps, part = story.diagnosed.diagnosis, _steps(story), PARTS[story.judges]
    floor = _share(story, diagnosis.noise_floor_m3s)
    if not np.isfinite([floor, *(value for _, value in steps)]).all():
        return Story("Error", (NOTHING,))
    caption = (
        f"Root mean square of measured less modelled chamber flow on the {part} of the record, "
        f"in per cent of the rms flow of {lpm() * diagnosis.rms_flow_m3s:.3g} "
        f"{flow_name()}: {steps[len(_saved(story))][1]:.2f} % for the model as it is"
    )
    caption += f", {steps[-1][1]:.2f} % with everything that was found." if diagnosis.found else "."
    if is_floor(floor):
        caption += f" Dashed: what the sensors' noise alone leaves, {floor:.2f} %."
    if not story.judges:
        caption += (
            " The map is known over too little of the held-out part of this record, so these "
            "errors are of the identification part."
        )
    bars = tuple(
        Bar(name, value, "first" if k == 0 and len(steps) > 1 else "")
        for k, (name, value) in enumerate(steps)
    )
    words = f"sensors' floor {floor:.2f} %", f"error on the {part} in % of the rms flow"
    shown = floor if is_floor(floor) else float("nan")
    return Story(f"Error on the {part}", (Bars("errors", "", bars, shown, *words, caption),))


def _flows(story: ReportStory) -> Story:
    heading_ = "Measured and modelled flow"
    if not any(len(part.t_s) for part in story.before):
        return Story(heading_, (NOTHING,))
    models = {BEFORE: story.before} | ({AFTER: story.after} if story.after else {})
    caption = (
        "Flow into each chamber as the piston's motion measures it (dark) and as the model gives "
        "it (orange); below, the difference. The blue part taught the model, the yellow part was "
        "held out. Everything passes the same 10 Hz filter. "
        f"The map is known well enough to judge {story.before[0].judged_s:.1f} s of the first "
        f"and "
        f"{story.before[1].judged_s:.1f} s of the second; the rest is left out."
    )
    if story.after:
        caption += " Left before, right with what was found, on the same scales."
    caption += " Drag to zoom in, double click for the whole record."
    return Story(heading_, (flows(story.chambers, models, caption),))


def _dependences(story: ReportStory) -> Story:
    heading_ = "What the residual depends on"
    if not story.depends_before:
        return Story(heading_, (NOTHING,))
    models = {BEFORE: story.depends_before}
    models |= {AFTER: story.depends_after} if story.depends_after else {}
    floor_m3s = story.diagnosed.diagnosis.noise_floor_m3s
    caption = (
        "Mean residual over bins of position, pressures, the signals that explain most of it and "
        "time, over the whole record, with its 95 % interval, and the share of the "
        "residual's variance that the bins explain. "
        "A trend says what the model misses; a right model lies on the zero line."
    )
    if is_floor(floor_m3s, story.diagnosed.diagnosis.rms_flow_m3s):
        caption += f" The sensors' noise is {lpm() * floor_m3s:.2g} {flow_name()} rms."
    return Story(heading_, (before_and_after(story.chambers, models, floor_m3s, caption),))


def _ranking(story: ReportStory) -> Story:
    if not story.ranking:
        return Story("Candidates", ("This record holds no candidate.",))
    caption = (
        "How clearly the record shows each effect when it is added alone to the model: its "
        "coefficient in standard deviations (bar: logarithmic). "
    )
    caption += (
        "While something large is missing, many effects imitate it; "
        "→ is what is left of them once the effect in orange is part of the model. What is "
        f"beyond {np.sqrt(GAIN):g} even then was not added where it changes less than "
        f"{100 * MATERIAL:g} % of the rms flow, explains little of what is left, or has an "
        "impossible sign or size."
        if story.after
        else f"Nothing beyond {np.sqrt(GAIN):g} counts unless it is also possible and material."
    )
    caption += f" {sizes_say(story.ranking, 'coefficient')}"
    ranked = story.ranking[:RANKED]
    bars = tuple(
        Bar(named(r.key), r.before or 0.0, "found" if r.after is None else "rival", r.after)
        for r in ranked
    )
    least = float(np.sqrt(GAIN))
    words = f"{least:g} sd: significant", "coefficient in units of its standard deviation, alone"
    drawn = Bars("ranking", "", bars, least, *words, caption, is_log=True)
    head = ("effect", "where", "sd before", "sd after", "coefficient", LIMITS[0])
    return Story("Candidates", (drawn, Table("", head, [_candidate(r) for r in ranked])))


def _candidate(ranked: Ranked) -> tuple[str, ...]:
    value = quantity(Value(ranked.value, ranked.std, ranked.unit))
    if ranked.per_shape is not None:
        value += f" of {limit(*ranked.per_shape)}"
    if not ranked.is_possible:
        value += ", not possible"
    before = "" if ranked.before is None else f"{ranked.before:.1f}"
    after = "in the model" if ranked.after is None else f"{ranked.after:.1f}"
    seen_from = limits(ranked.unseen)[0] if ranked.unseen else ""
    return title(ranked.key[0]), ranked.key[1], before, after, value, seen_from


def _not_found(result: Diagnosis, ranking: tuple[Ranked, ...]) -> tuple[Story, ...]:
    """What was not found with its detection limits, and what the record cannot show."""
    clear = {r.key: r for r in ranking if r.after is not None and r.after > LIMIT_SD}
    listed = folded(result.not_found)
    seen = [u for u in listed if u.visible and u.detection_limit is not None]
    hidden = [u for u in listed if u not in seen]
    rows = [
        (
            title(u.effect),
            u.where,
            *limits(u),
            remark(u) or _why_not(clear.get((u.effect, u.where))),
        )
        for u in seen
    ]
    blind = [(title(u.effect), u.where, u.reason) for u in hidden]
    head = ("effect", "where", *LIMITS, "remark")
    parts: list[StoryPart] = [limits_say(result), Table("", head, rows)]
    if hidden:
        parts.append(Table("What this record cannot show", ("effect", "where", "why"), blind))
    return (Story("Looked for and not found", tuple(parts)),)


def _why_not(clear: Ranked | None) -> str:
    """A remark on what stands out and was not added all the same."""
    if clear is None:
        return ""
    if not clear.is_possible:
        return f"{clear.after:.0f} sd, of an impossible sign or size"
    return f"{clear.after:.0f} sd, immaterial or no explanation"


def _negligible(story: ReportStory) -> tuple[Story, ...]:
    """Effects that are present and change next to nothing; nothing where there is none."""
    rows = [
        (title(s.effect), s.where, f"{100 * s.heldout_share_of_rms_flow:.2g} % of the rms flow")
        for s in story.diagnosed.diagnosis.negligible
    ]
    head = ("effect", "where", "what it changes")
    return (Story("Present but negligible", (Table("", head, rows),)),) if rows else ()


def _history(changes: tuple[Change, ...]) -> tuple[Story, ...]:
    """What was added and dropped, and what it brought; nothing where there is no history."""
    return (Story("History of the model", (history_table(changes),)),) if changes else ()


def _provenance(story: ReportStory) -> Story:
    trace, project = story.diagnosed.trace, story.diagnosed.project
    refused = ", ".join(f"{name} {n}" for name, n in sorted(trace.counters.items()) if n)
    rows = [
        ("trace", f"{trace.path.name}, {trace.duration_s:.1f} s, {len(trace.samples)} samples"),
        ("SHA-256 of the trace", story.trace_sha256),
        ("counted while reading", refused or "nothing refused"),
        ("project", f"{project.path.name} ({project.sections.project.name})"),
        ("digest of the project", project.digest),
        *settings(story),
        ("written", f"{story.date} by rtid {rtid.__version__}"),
    ]
    return Story("Where this comes from", (Table("", ("", ""), rows),))
