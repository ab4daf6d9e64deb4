"""The page of `rtid report`: one HTML text with its pictures inside, nothing to load.

The pictures are those of the page (`report_plots`).
"""

from __future__ import annotations

from html import escape

import numpy as np
from bokeh.models import UIElement

import rtid
from rtid.diagnose.residual import ROWS_PER_S, Residual
from rtid.diagnose.trials import GAIN
from rtid.diagnose.verdict import MATERIAL
from rtid.diagnosed_text import sentences
from rtid.report_errors import PARTS, RANKED, can_be_judged, floor, models, share, steps
from rtid.report_plots import dependences, embedded, errors, flows, ranking
from rtid.report_story import Told
from rtid.report_tables import candidates, history, negligible, not_found, section, table
from rtid.report_template import PAGE
from rtid.report_words import VERDICTS, text
from rtid.units import LPM

NOTHING = "<p>No flow of this record could be judged.</p>"


def page(told: Told) -> str:
    """The whole HTML text."""
    head, drawn = _drawn(told)
    found = told.diagnosed.diagnosis
    kind, headline = VERDICTS[found.verdict]
    sections = [
        _errors(told, drawn),
        _flows(told, drawn),
        _dependences(told, drawn),
        _ranking(told, drawn),
        not_found(found.not_found, told.ranking),
        negligible(found.negligible),
        history(told.history),
        _provenance(told),
    ]
    name = told.diagnosed.project.sections.project.name
    return PAGE.substitute(
        head=head,
        title=escape(f"{name}: {told.diagnosed.trace.path.name}"),
        kind=kind,
        headline=escape(headline),
        sentences="".join(f"<p>{text(s)}</p>" for s in sentences(found)),
        figures=_key_figures(told),
        sections="\n".join(sections),
    )


def _drawn(told: Told) -> tuple[str, dict[str, str]]:
    """Head of the file, and its pictures by name: those that this record has."""
    figures: dict[str, UIElement] = {}
    if any(len(part.t_s) for part in told.before):
        figures["flows"] = flows(told.chambers, models(told.before, told.after))
    if told.depends_before:
        depends = models(told.depends_before, told.depends_after or None)
        figures["dependences"] = dependences(told.chambers, depends)
    head, drawn = embedded(figures)
    if can_be_judged(told):
        drawn["errors"] = errors(steps(told), floor(told))
    if told.ranking:
        drawn["ranking"] = ranking(told.ranking[:RANKED])
    return head, drawn


def _picture(drawn: str, caption: str) -> str:
    return f"<figure>{drawn}<figcaption>{text(caption)}</figcaption></figure>"


def _percent(told: Told, residual_m3s: float) -> str:
    value = share(told, residual_m3s)
    return f"{value:.2f} %" if np.isfinite(value) else "not known"


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


def _errors(told: Told, drawn: dict[str, str]) -> str:
    if "errors" not in drawn:
        return section("Error", NOTHING)
    found, part, found_steps = told.diagnosed.diagnosis, PARTS[told.judges], steps(told)
    caption = (
        f"Root mean square of measured less modelled chamber flow on the {part} of the record, "
        f"in per cent of the rms flow of {LPM * found.rms_flow_m3s:.3g} "
        f"L/min: {found_steps[0][1]:.2f} % for the model as it is"
    )
    caption += (
        f", {found_steps[-1][1]:.2f} % with everything that was found." if found.found else "."
    )
    caption += f" Dashed: what the sensors' noise alone leaves, {floor(told):.2f} %."
    if not told.judges:
        caption += (
            " The map is known over too little of the held-out part of this record, so these "
            "errors are of the identification part."
        )
    return section(f"Error on the {part}", _picture(drawn["errors"], caption))


def _flows(told: Told, drawn: dict[str, str]) -> str:
    if "flows" not in drawn:
        return section("Measured and modelled flow", NOTHING)
    caption = (
        "Flow into each chamber as the piston's motion measures it (dark) and as the model gives "
        "it (orange); below, the difference. The blue part taught the model, the yellow part was "
        "held out. Everything passes the same 10 Hz filter. "
        f"The map is known well enough to judge {_judged_s(told.before[0]):.1f} s of the first and "
        f"{_judged_s(told.before[1]):.1f} s of the second; the rest is left out."
    )
    if told.after:
        caption += " Left before, right with what was found, on the same scales."
    caption += " Drag to zoom in, double click for the whole record."
    return section("Measured and modelled flow", _picture(drawn["flows"], caption))


def _judged_s(part: Residual) -> float:
    return len(part.t_s) / ROWS_PER_S


def _dependences(told: Told, drawn: dict[str, str]) -> str:
    heading = "What the residual depends on"
    if not told.depends_before:
        return section(heading, NOTHING)
    caption = (
        "Mean residual over bins of position, pressures, the signals that explain most of it and "
        "time, over the whole record, with its 95 % interval; above each the share of the "
        "residual's variance that the bins explain. "
        "A trend says what the model misses; a right model lies on the zero line. The sensors' "
        f"noise is {LPM * told.diagnosed.diagnosis.noise_floor_m3s:.2g} L/min rms."
    )
    return section(heading, _picture(drawn["dependences"], caption))


def _ranking(told: Told, drawn: dict[str, str]) -> str:
    if not told.ranking:
        return section("Candidates", "<p>This record holds no candidate.</p>")
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
        if told.after
        else f"Nothing beyond {np.sqrt(GAIN):g} counts unless it is also possible and material."
    )
    return section(
        "Candidates",
        _picture(drawn["ranking"], caption),
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
