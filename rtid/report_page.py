"""The page of `rtid report`: one HTML text with its pictures inside, nothing to load.

Pictures are SVG in data URIs; on a dark screen the style sheet turns their lightness round and
keeps their hues.
"""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import rtid
from rtid.diagnose.residual import ROWS_PER_S, Residual
from rtid.diagnose.trials import GAIN
from rtid.diagnose.verdict import MATERIAL
from rtid.diagnosed_text import sentences, title
from rtid.pictures.diagnosed import Rank, dependences, errors, flows, ranking
from rtid.pictures.style import STYLE
from rtid.report_story import Told
from rtid.report_tables import (
    candidates,
    history,
    named,
    negligible,
    not_found,
    section,
    table,
)
from rtid.report_template import PAGE
from rtid.report_words import VERDICTS, text
from rtid.units import LPM

PARTS = "identification part", "held-out part"
RANKED = 16  # candidates that are shown
BEFORE, AFTER = "model as it is", "with what was found"


def page(told: Told) -> str:
    """The whole HTML text."""
    found = told.diagnosed.diagnosis
    kind, headline = VERDICTS[found.verdict]
    sections = [
        _errors(told),
        _flows(told),
        _dependences(told),
        _ranking(told),
        not_found(found.not_found, told.ranking),
        negligible(found.negligible),
        history(told.history),
        _provenance(told),
    ]
    name = told.diagnosed.project.sections.project.name
    return PAGE.substitute(
        title=escape(f"{name}: {told.diagnosed.trace.path.name}"),
        kind=kind,
        headline=escape(headline),
        sentences="".join(f"<p>{text(s)}</p>" for s in sentences(found)),
        figures=_key_figures(told),
        sections="\n".join(sections),
    )


def _picture(figure: Figure, name: str, caption: str) -> str:
    buffer = BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    data = b64encode(buffer.getvalue()).decode()
    return (
        f'<figure><img alt="{escape(name)}" src="data:image/svg+xml;base64,{data}">'
        f"<figcaption>{text(caption)}</figcaption></figure>"
    )


def stills(told: Told) -> dict[str, Figure]:
    """The pictures of the page by name, those that this record has."""
    drawn: dict[str, Figure] = {}
    if _can_be_judged(told):
        drawn["errors"] = _errors_figure(told)
    drawn["flows"] = _flows_figure(told)
    if told.depends_before:
        drawn["dependences"] = _dependences_figure(told)
    if told.ranking:
        drawn["ranking"] = _ranking_figure(told)
    return drawn


def _share(told: Told, residual_m3s: float) -> float:
    return 100.0 * residual_m3s / told.diagnosed.diagnosis.rms_flow_m3s


def _percent(told: Told, residual_m3s: float) -> str:
    share = _share(told, residual_m3s)
    return f"{share:.2f} %" if np.isfinite(share) else "not known"


def _key_figures(told: Told) -> str:
    found = told.diagnosed.diagnosis
    before = _percent(told, found.heldout_residual_before_m3s)
    after = _percent(told, found.heldout_residual_after_m3s)
    rho = f"{found.rho_before:.3g}"
    beta = " / ".join(f"{b / 1e6:.0f}" for b in found.beta_pa)
    if found.found:
        before, rho = f"{before} → {after}", f"{rho} → {found.rho_after:.3g}"
    cards = {
        f"error on the {PARTS[told.judges]}, of the rms flow": before,
        "what the sensors alone leave": _percent(told, found.noise_floor_m3s),
        "residual variance, of the noise": rho,
        f"bulk modulus {' / '.join(told.chambers)}": f"{beta} MPa",
    }
    return "".join(
        f"<div><b>{text(value)}</b><span>{escape(name)}</span></div>"
        for name, value in cards.items()
    )


def _steps(told: Told) -> list[tuple[str, float]]:
    """Error behind each addition, in per cent of the rms flow."""
    found = told.diagnosed.diagnosis
    start = BEFORE if not found.added else "model with what was added before"
    steps = [(start, _share(told, found.heldout_residual_before_m3s))]
    steps += [
        (f"+ {title(e.effect)} ({e.where})", _share(told, e.heldout_residual_after_m3s))
        for e in found.found
    ]
    last = _share(told, found.heldout_residual_after_m3s)
    if found.found and found.negligible and not np.isclose(last, steps[-1][1], rtol=0.01):
        steps.append(("+ what is present but negligible", last))
    return steps


def _floor(told: Told) -> float:
    return _share(told, told.diagnosed.diagnosis.noise_floor_m3s)


def _can_be_judged(told: Told) -> bool:
    return all(np.isfinite([_floor(told), *(value for _, value in _steps(told))]))


def _errors_figure(told: Told) -> Figure:
    return errors(_steps(told), _floor(told), PARTS[told.judges])


def _errors(told: Told) -> str:
    if not _can_be_judged(told):
        return section("Error", "<p>No flow of the record could be judged.</p>")
    found, part, steps = told.diagnosed.diagnosis, PARTS[told.judges], _steps(told)
    caption = (
        f"Root mean square of measured less modelled chamber flow on the {part} of the record, "
        f"in per cent of the rms flow of {LPM * found.rms_flow_m3s:.3g} "
        f"L/min: {steps[0][1]:.2f} % for the model as it is"
    )
    caption += f", {steps[-1][1]:.2f} % with everything that was found." if found.found else "."
    caption += f" Dashed: what the sensors' noise alone leaves, {_floor(told):.2f} %."
    if not told.judges:
        caption += (
            " The map is known over too little of the held-out part of this record, so these "
            "errors are of the identification part."
        )
    picture = _picture(_errors_figure(told), "error bars", caption)
    return section(f"Error on the {part}", picture)


def _flows_figure(told: Told) -> Figure:
    models = {BEFORE: told.before} | ({AFTER: told.after} if told.after else {})
    return flows(told.chambers, models)


def _flows(told: Told) -> str:
    caption = (
        "Flow into each chamber as the piston's motion measures it (dark) and as the model gives "
        "it (orange); below, the difference. The blue part taught the model, the yellow part was "
        "held out. Everything passes the same 10 Hz filter. "
        f"The map is known well enough to judge {_judged_s(told.before[0]):.1f} s of the first and "
        f"{_judged_s(told.before[1]):.1f} s of the second; the rest is left out."
    )
    if told.after:
        caption += " Left before, right with what was found, on the same scales."
    picture = _picture(_flows_figure(told), "measured and modelled flow", caption)
    return section("Measured and modelled flow", picture)


def _judged_s(part: Residual) -> float:
    return len(part.t_s) / ROWS_PER_S


def _dependences_figure(told: Told) -> Figure:
    models = {BEFORE: told.depends_before}
    if told.depends_after:
        models[AFTER] = told.depends_after
    return dependences(told.chambers, models, told.diagnosed.diagnosis.noise_floor_m3s)


def _dependences(told: Told) -> str:
    heading = "What the residual depends on"
    if not told.depends_before:
        return section(heading, "<p>No flow of this record could be judged.</p>")
    caption = (
        "Mean residual over bins of position, pressures, the signals that explain most of it and "
        "time, over the whole record, with its 95 % interval; in the corner the share of the "
        "residual's variance that the bins explain. "
        "A trend says what the model misses; a right model lies on the zero line. The grey band is "
        "the rms of the sensors' noise."
    )
    return section(heading, _picture(_dependences_figure(told), "residual by signal", caption))


def _ranking_figure(told: Told) -> Figure:
    ranks = [Rank(named(r.key), r.before, r.after) for r in told.ranking[:RANKED]]
    return ranking(ranks, float(np.sqrt(GAIN)))


def _ranking(told: Told) -> str:
    if not told.ranking:
        return section("Candidates", "<p>This record holds no candidate.</p>")
    caption = (
        "How clearly the record shows each effect when it is added alone to the model: its "
        "coefficient in standard deviations. "
    )
    caption += (
        "While something large is missing, many effects imitate it; "
        "the squares show what is left of them once the effect in orange is part of the model. A "
        f"square right of the dashed line was not added where it changes less than "
        f"{100 * MATERIAL:g} % of the rms flow, explains little of what is left, or has an "
        "impossible sign or size."
        if told.after
        else f"Nothing beyond {np.sqrt(GAIN):g} counts unless it is also possible and material."
    )
    return section(
        "Candidates",
        _picture(_ranking_figure(told), "ranking of the candidates", caption),
        candidates(told.ranking[:RANKED]),
    )


def _provenance(told: Told) -> str:
    trace, project = told.diagnosed.trace, told.diagnosed.project
    refused = ", ".join(f"{name} {n}" for name, n in sorted(trace.counters.items()) if n)
    rows = [
        ("trace", f"{trace.path.name}, {trace.duration_s:.1f} s, {len(trace.samples)} samples"),
        ("SHA-256 of the trace", told.trace_sha256),
        ("counted while reading", refused or "nothing refused"),
        ("project", f"{project.path.name} ({project.sections.project.name})"),
        ("digest of the project", project.digest),
        ("written", f"{told.date} by rtid {rtid.__version__}"),
    ]
    return section("Where this comes from", table(("", ""), rows))
