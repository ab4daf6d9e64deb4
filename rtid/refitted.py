"""A refit or a diagnosis by output error in words and in JSON.

JSON, schema 1, has the keys of the hydraulic diagnosis: verdict, found (effect, where,
cannot_be_told_from, parameters, p_value, heldout_gain_pct), not_found, negligible, advice; errors
of the free run per output under rmse_before and rmse_after, in the output's unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rtid.comparing_json import plain
from rtid.effects.tree import written
from rtid.output_error.diagnosis import AMBIGUOUS, MATCHES, UNKNOWN, Diagnosis, Found, rho
from rtid.output_error.entries import AMPLITUDE, GAP, INPUT, TIME, page_of
from rtid.output_error.insertion import Added, unit_of
from rtid.output_error.model import Key, Model
from rtid.output_error.problem import scales
from rtid.output_error.statistics import covariance
from rtid.refitting import Refitted

SCHEMA = 1
LIMIT_SD = 4.0  # standard deviations that an effect must have to be seen
BEYOND = "it would act only beyond what this record reaches, or changes nothing in it: "
FADING = (AMPLITUDE, INPUT, TIME, GAP)  # kinds of parameters at whose zero the effect is gone


def as_json(found: Refitted) -> dict[str, Any]:
    """Everything in plain JSON types; NaN is null."""
    plant, model = found.file.plant, found.last
    outputs = [o.name for o in plant.outputs]
    before, after = found.errors(found.first), found.errors(model)
    told = {
        "schema": SCHEMA,
        "plant": plant.name,
        "outputs": {o.name: o.unit for o in plant.outputs},
        "rmse_before": {
            part: dict(zip(outputs, plain(e), strict=True)) for part, e in before.items()
        },
        "rmse_after": {
            part: dict(zip(outputs, plain(e), strict=True)) for part, e in after.items()
        },
        "effects": [{"effect": effect, "where": where} for effect, where in model.keys],
        "parameters": [
            {"name": p.name, "value": plain(v), "std": plain(sd), "unit": unit}
            for (p, v, sd), unit in zip(_values(model), _units(model), strict=True)
        ],
        "condition": plain(model.fit.condition[0]),
        "not_identifiable": list(model.fit.condition[1]),
        "independent_samples": plain(model.fit.worth),
        "equations": dict(_equations(model)),
    }
    return told if found.diagnosis is None else told | _diagnosed(found.diagnosis)


def _diagnosed(d: Diagnosis) -> dict[str, Any]:
    return {
        "verdict": d.verdict,
        "noise": plain(d.noise),
        "rho_before": plain(rho(d.first, d.noise)),
        "rho_after": plain(rho(d.last, d.noise)),
        "found": [_found(d.last, f) for f in d.found],
        "negligible": [
            {"effect": f.key[0], "where": f.key[1], "heldout_gain_pct": plain(f.gain_percent)}
            for f in d.negligible
        ],
        "not_found": list(_not_found(d)),
        "search": [
            {"effect": effect, "where": where, "rmse": plain(e)} for (effect, where), e in d.path
        ],
        "advice": list(advice(d)),
    }


def _found(model: Model, f: Found) -> dict[str, Any]:
    parameters = [
        {"name": a.label, "value": plain(v), "std": plain(sd), "unit": _unit(model, f.key, a)}
        for a in model.parameters(f.key)
        for v, sd in [model.fit.value(a.name)]
    ]
    return {
        "effect": f.key[0],
        "where": f.key[1],
        "cannot_be_told_from": [{"effect": e, "where": w} for e, w in f.alike],
        "parameters": parameters,
        "p_value": plain(f.p_value),
        "heldout_gain_pct": plain(f.gain_percent),
    }


def _not_found(d: Diagnosis) -> Iterator[dict[str, Any]]:
    for model in d.rivals:
        key = model.keys[-1]
        added = model.parameters(key)[0]
        limit = LIMIT_SD * smallest_sd(model, added) if added.kind in FADING else np.nan
        visible = bool(np.isfinite(limit))
        yield {
            "effect": key[0],
            "where": key[1],
            "detection_limit": plain(limit) if visible else None,
            "parameter": added.label,
            "unit": _unit(model, key, added),
            "visible": visible,
            "reason": "" if visible else BEYOND + page_of(key[0]).visible_when,
        }


def smallest_sd(model: Model, added: Added) -> float:
    """Standard deviation of an effect's first parameter beside the plant's own unknowns."""
    fit, names = model.fit, [p.name for p in model.fit.plant.unknowns]
    others = {a.name for a in model.parameters(model.keys[-1])} - {added.name}
    own = names.index(added.name)
    columns = [k for k, n in enumerate(names) if (fit.free[k] and n not in others) or k == own]
    scale = scales(fit.simulator)
    jacobian = fit.jacobian[:, :, columns] / scale[:, None]
    if not np.any(jacobian[:, :, columns.index(own)]):
        return np.inf
    spread = covariance(jacobian, fit.residual / scale)
    return float(np.sqrt(spread[columns.index(own), columns.index(own)]))


def advice(d: Diagnosis) -> Iterator[str]:
    """What to do next, in sentences."""
    for f in d.found:
        if f.alike:
            yield f"To tell {_spoken(f.key)} from the others: {page_of(f.key[0]).separates}"
    left = rho(d.last, d.noise)
    if d.verdict == UNKNOWN or (d.found and left > 2.0):
        yield (
            f"What is left of the error is {np.sqrt(left):.1f} times the sensors' noise: look at "
            "the residual beside states and inputs, and put a term of your own into the equations."
        )
    names = d.last.fit.condition[1]
    if names:
        yield f"The record does not identify {', '.join(names)} apart: fix one of them."


def _values(model: Model) -> Iterator[tuple[Any, float, float]]:
    fit = model.fit
    yield from zip(fit.plant.unknowns, fit.values.tolist(), fit.sd.tolist(), strict=True)


def _units(model: Model) -> list[str]:
    own = {a.name: _unit(model, key, a) for key, added in model.effects for a in added}
    return [own.get(p.name, p.unit) for p in model.fit.plant.unknowns]


def _unit(model: Model, key: Key, added: Added) -> str:
    return unit_of(model.base, *key, added)


def _equations(model: Model) -> Iterator[tuple[str, str]]:
    plant = model.fit.plant
    yield from ((f"{s.name}'", written(s.rate)) for s in plant.states)
    for i in plant.inputs:
        late = f" delayed by {i.delay}" if i.delay else ""
        if late or written(i.acts) != i.name:
            yield f"{i.name} acts as", written(i.acts) + late
    for o in plant.outputs:
        yield o.name, written(o.value) + (f" behind a gap {o.play}" if o.play else "")


def _spoken(key: Key) -> str:
    return f"{page_of(key[0]).title.lower()} at {key[1]}"


def tell(console: Console, found: Refitted) -> None:
    """Sentences first, then the tables."""
    for line in sentences(found):
        console.print(line)
    console.print()
    console.print(_parameter_table(found.last))
    for left, right in _equations(found.last):
        console.print(f"  {left} = {right}")
    if found.diagnosis is not None:
        console.print()
        console.print(_not_found_table(found.diagnosis))


def sentences(found: Refitted) -> Iterator[str]:
    """What was found, in plain words."""
    before, after = found.errors(found.first), found.errors(found.last)
    yield f"{found.file.plant.name}: free run of the equations over the record."
    for k, output in enumerate(found.file.plant.outputs):
        for part, error in before.items():
            line = f"  {output.name}, {part} part: error {error[k]:.4g} {output.unit} (rms)"
            if found.last is not found.first:
                line += f", with what was added {after[part][k]:.4g} {output.unit}"
            yield line + "."
    if found.diagnosis is not None:
        yield from _diagnosis_sentences(found.diagnosis)
    else:
        names = found.last.fit.condition[1]
        if names:
            yield f"The record does not identify {', '.join(names)} apart: fix one of them."


def _diagnosis_sentences(d: Diagnosis) -> Iterator[str]:
    yield f"Verdict: {d.verdict}."
    if d.verdict == MATCHES:
        yield "No effect of the catalogue is missing as far as this record can tell."
    if d.verdict == UNKNOWN:
        yield "Something is missing that no effect of the catalogue explains."
    if d.verdict == AMBIGUOUS:
        yield "The effect below cannot be told from the others that are named with it."
    for f in d.found:
        parts = []
        for a in d.last.parameters(f.key):
            value, sd = d.last.fit.value(a.name)
            spread = f" +- {sd:.2g}" if np.isfinite(sd) else " (at its bound)"
            parts.append(f"{a.label} {value:.4g}{spread} {_unit(d.last, f.key, a)}")
        yield f"Missing: {_spoken(f.key)}: {', '.join(parts)}."
        left_out = f"{np.mean(f.held_out_before):.4g} to {np.mean(f.held_out_after):.4g}"
        yield f"  With it the error on blocks left out falls from {left_out} (p = {f.p_value:.2g})."
        if f.alike:
            names = " or ".join(_spoken(key) for key in f.alike)
            yield f"  It cannot be told from {names}."
    if d.found:
        names = " ".join(f"--add {effect}:{where}" for effect, where in d.last.keys)
        yield f"To fit with what was found: {names}."
    for f in d.negligible:
        yield f"Present but negligible: {_spoken(f.key)}."
    yield from advice(d)


def _parameter_table(model: Model) -> Table:
    table = Table(title="what was estimated (1 standard deviation)", title_justify="left")
    for head in ("name", "value", "+-", "unit"):
        table.add_column(head, justify="left" if head in ("name", "unit") else "right")
    for (p, value, sd), unit in zip(_values(model), _units(model), strict=True):
        spread = f"{sd:.2g}" if np.isfinite(sd) else "at its bound"
        table.add_row(p.name, f"{value:.5g}", spread, unit)
    return table


def _not_found_table(d: Diagnosis) -> Table:
    title = f"not found: the smallest size that would have been seen ({LIMIT_SD:g} sd)"
    table = Table(title=title, title_justify="left")
    for head in ("effect", "at", "limit", "unit"):
        table.add_column(head)
    for row in _not_found(d):
        size = "only beyond the record"
        if row["visible"]:
            size = f"{row['parameter']} {row['detection_limit']:.3g}"
        table.add_row(row["effect"], row["where"], size, row["unit"])
    return table
