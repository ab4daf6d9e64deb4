"""A refit or a diagnosis by output error in words and in JSON.

JSON, schema 1, has the keys of the hydraulic diagnosis: verdict, found (effect, where,
cannot_be_told_from, parameters, p_value, heldout_gain_pct), not_found, negligible, advice; errors
of the free run per output under rmse_before and rmse_after, in the output's unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from rich.console import Console

from rtid.effects.tree import written
from rtid.plain import Key, plain
from rtid.plants.entries import AMPLITUDE, GAP, INPUT, TIME, page_of
from rtid.plants.fitted import PlantModel
from rtid.plants.insertion import EffectParameter, unit_of
from rtid.plants.missing import AMBIGUOUS, MATCHES, UNKNOWN, MissingEffect, PlantDiagnosis, rho
from rtid.plants.plant import PlantRecord
from rtid.plants.problem import scales
from rtid.plants.statistics import covariance
from rtid.study.refit import FEWEST_ROWS, Refitted
from rtid.tell.story import Table
from rtid.units import CONVENTION, Z95

SCHEMA = 1
LIMIT_SD = 4.0  # standard deviations that an effect must have to be seen
BEYOND = "it would act only beyond what this record reaches, or changes nothing in it: "
FADING = (AMPLITUDE, INPUT, TIME, GAP)  # kinds of parameters at whose zero the effect is gone


def as_json(refitted: Refitted) -> dict[str, Any]:
    """Everything in plain JSON types; NaN is null."""
    plant, model = refitted.file.plant, refitted.last
    outputs = [o.name for o in plant.outputs]

    def errors(fitted: PlantModel) -> dict[str, dict[str, Any]]:
        parts = refitted.errors(fitted).items()
        return {part: dict(zip(outputs, plain(e), strict=True)) for part, e in parts}

    document = {
        "schema": SCHEMA,
        "plant": plant.name,
        "outputs": {o.name: o.unit for o in plant.outputs},
        "parts": {
            name: [{"from_s": plain(a), "to_s": plain(b)} for a, b in spans(record)]
            for name, record in refitted.records.named
        },
        "rmse_before": errors(refitted.first),
        "rmse_after": errors(model),
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
    return document if refitted.diagnosis is None else document | _diagnosed(refitted.diagnosis)


def _diagnosed(d: PlantDiagnosis) -> dict[str, Any]:
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
        "refuted": [
            {
                "effect": r.key[0],
                "where": r.key[1],
                "validation_rmse_without": plain(r.unseen_before),
                "validation_rmse_with": plain(r.unseen_after),
            }
            for r in d.refuted
        ],
        "not_found": list(_not_found(d)),
        "search": [
            {"effect": effect, "where": where, "rmse": plain(e)} for (effect, where), e in d.path
        ],
        "advice": list(advice(d)),
    }


def _found(model: PlantModel, f: MissingEffect) -> dict[str, Any]:
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


def _not_found(d: PlantDiagnosis) -> Iterator[dict[str, Any]]:
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


def smallest_sd(model: PlantModel, added: EffectParameter) -> float:
    """Standard deviation of an effect's first parameter beside the plant's own unknowns."""
    fit, names = model.fit, [p.name for p in model.fit.plant.unknowns]
    others = {a.name for a in model.parameters(model.keys[-1])} - {added.name}
    place = names.index(added.name)
    columns = [k for k, n in enumerate(names) if (fit.free[k] and n not in others) or k == place]
    scale = scales(fit.simulator)
    jacobian = fit.jacobian[:, :, columns] / scale[:, None]
    if not np.any(jacobian[:, :, columns.index(place)]):
        return np.inf
    spread = covariance(jacobian, fit.residual / scale)
    return float(np.sqrt(spread[columns.index(place), columns.index(place)]))


def advice(d: PlantDiagnosis) -> Iterator[str]:
    """What to do next, in sentences."""
    for f in d.found:
        if f.alike:
            yield f"To tell {_spoken(f.key)} from the others: {page_of(f.key[0]).separates}"
    rest = rho(d.last, d.noise)
    if d.verdict == UNKNOWN or (d.found and rest > 2.0):
        yield (
            f"What is left of the error is {np.sqrt(rest):.1f} times the sensors' noise: look at "
            "the residual beside states and inputs, and put a term of your own into the equations."
        )
    names = d.last.fit.condition[1]
    if names:
        yield f"The record does not identify {', '.join(names)} apart: fix one of them."


def _values(model: PlantModel) -> Iterator[tuple[Any, float, float]]:
    fit = model.fit
    yield from zip(fit.plant.unknowns, fit.values.tolist(), fit.sd.tolist(), strict=True)


def _units(model: PlantModel) -> list[str]:
    units = {a.name: _unit(model, key, a) for key, added in model.effects for a in added}
    return [units.get(p.name, p.unit) for p in model.fit.plant.unknowns]


def _unit(model: PlantModel, key: Key, added: EffectParameter) -> str:
    return unit_of(model.base, *key, added)


def _equations(model: PlantModel) -> Iterator[tuple[str, str]]:
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


def tell(console: Console, refitted: Refitted) -> None:
    """Sentences first, then the tables."""
    for line in sentences(refitted):
        console.print(line)
    console.print()
    console.print(_parameter_table(refitted.last))
    console.print(CONVENTION)
    for left, right in _equations(refitted.last):
        console.print(f"  {left} = {right}")
    if refitted.diagnosis is not None:
        console.print()
        console.print(_not_found_table(refitted.diagnosis))


def sentences(refitted: Refitted) -> Iterator[str]:
    """What was found, in plain words."""
    before, after = refitted.errors(refitted.first), refitted.errors(refitted.last)
    yield f"{refitted.file.plant.name}: free run of the equations over the record."
    for begin, end in refitted.records.left_out:
        yield (
            f"  Left out: {begin:.4g} to {end:.4g} s, fewer than {FEWEST_ROWS} rows beside a gap "
            "in the table."
        )
    for name, record in refitted.records.named:
        yield from _gaps(name, record)
    for k, output in enumerate(refitted.file.plant.outputs):
        for part, error in before.items():
            line = f"  {output.name}, {part} part: error {error[k]:.4g} {output.unit} (rms)"
            if refitted.last is not refitted.first:
                line += f", with what was added {after[part][k]:.4g} {output.unit}"
            yield line + "."
    if refitted.diagnosis is not None:
        yield from _diagnosis_sentences(refitted.diagnosis)
    else:
        names = refitted.last.fit.condition[1]
        if names:
            yield f"The record does not identify {', '.join(names)} apart: fix one of them."


def _gaps(name: str, record: PlantRecord) -> Iterator[str]:
    """What was done at the gaps of a part of the record."""
    result = spans(record)
    if len(result) == 1:
        return
    gaps = ", ".join(f"{b[0] - a[1]:.3g} s from {a[1]:.4g} s on" for a, b in pairwise(result))
    yield (
        f"  The {name} part has gaps ({gaps}): its free run begins anew behind each, in "
        f"{len(result)} pieces, from initial values of their own."
    )


def spans(record: PlantRecord) -> list[tuple[float, float]]:
    """Begin and end of every piece of a record between its gaps, s."""
    pieces = np.split(record.t_s, record.starts[1:])
    return [(float(t[0]), float(t[-1])) for t in pieces]


def _diagnosis_sentences(d: PlantDiagnosis) -> Iterator[str]:
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
            spread = f" ± {Z95 * sd:.2g}" if np.isfinite(sd) else " (at its bound)"
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
    for r in d.refuted:
        yield (
            f"Not named: {_spoken(r.key)}. It helps where it was fitted, but the error on the "
            f"validation part goes from {np.mean(r.unseen_before):.4g} to "
            f"{np.mean(r.unseen_after):.4g} with it."
        )
    for f in d.negligible:
        yield f"Present but negligible: {_spoken(f.key)}."
    yield from advice(d)


def _parameter_table(model: PlantModel) -> Table:
    rows = [
        (p.name, f"{value:.5g}", f"{Z95 * sd:.2g}" if np.isfinite(sd) else "at its bound", unit)
        for (p, value, sd), unit in zip(_values(model), _units(model), strict=True)
    ]
    return Table("what was estimated", ("name", "value|", "±|", "unit"), rows)


def _not_found_table(d: PlantDiagnosis) -> Table:
    title = f"not found: the smallest size that would have been seen ({LIMIT_SD:g} sd)"
    rows = []
    for row in _not_found(d):
        size = "only beyond the record"
        if row["visible"]:
            size = f"{row['parameter']} {row['detection_limit']:.3g}"
        rows.append((row["effect"], row["where"], size, row["unit"]))
    return Table(title, ("effect", "at", "limit", "unit"), rows, keys=2)
