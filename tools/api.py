"""Write docs/api.md from the docstrings of the public entry points: `python -m tools.api`.

The page holds what somebody calls who uses rtid as a library, and no more; a test holds it up to
date.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "docs" / "api.md"
SECTIONS = {
    "Project and trace": (
        *("rtid.project:load", "rtid.project:Project", "rtid.trace.reading:read_trace"),
        *("rtid.trace.reading:Trace", "firmware_bridge.samples:Samples"),
    ),
    "What is declared": (
        *("rtid.model:Machine", "rtid.model:Signal", "rtid.model:Chamber", "rtid.model:Edge"),
        *("rtid.model:Grid", "rtid.model:Term"),
    ),
    "Learn": (
        *("rtid.study.replay:replay", "rtid.study.replay:Replay"),
        *("rtid.estimator.estimator:Estimator", "rtid.estimator.chunk:to_chunk"),
        *("rtid.tell.arrays:fit", "rtid.study.study:Study"),
        *("rtid.estimator.record:fit_record", "rtid.estimator.record:RecordFit"),
        *("rtid.estimator.solution:Solution", "rtid.estimator.blocks:Block"),
        "rtid.estimator.batch:fit_batch",
    ),
    "Map": (
        *("rtid.estimator.published:publish", "rtid.estimator.flowmap:FlowMap"),
        *(
            "rtid.estimator.flowmap:EdgeMap",
            "rtid.maps.prior_map:find_prior",
            "rtid.maps.prior_map:published",
        ),
        *(
            "rtid.maps.files:write_map",
            "rtid.maps.files:read_map",
            "rtid.maps.datasheet:read_reference",
        ),
    ),
    "Where the model fails": (
        *(
            "rtid.study.compared:compare_trace",
            "rtid.study.compared:study",
            "rtid.study.compared:TraceComparison",
        ),
        *("rtid.study.compared:Held", "rtid.compare.comparison:Comparison"),
        *("rtid.study.compared:spans_of_block", "rtid.study.compared:blocks_in_span"),
    ),
    "What is missing, and adding it": (
        *("rtid.study.study:diagnose_trace", "rtid.study.study:diagnose_live"),
        *("rtid.diagnose.report:Diagnosis", "rtid.diagnose.report:FoundEffect"),
        *(
            "rtid.study.revisions:add",
            "rtid.study.revisions:drop",
            "rtid.study.revisions:undo",
            "rtid.project.history:history",
        ),
        "rtid.effects:define",
    ),
    "A motion that tells more": ("rtid.excite.exciting:excite",),
    "Keep what was learned": ("rtid.trace.snapshot:save", "rtid.trace.snapshot:load"),
    "Simulated machines": (
        *("rtid.sim.run:simulate", "rtid.sim.run:Run", "rtid.sim.recording:write_run"),
        "rtid.sim.declare:declared_model",
    ),
}
HEAD = """# API

Written from the docstrings by `python -m tools.api`. Arrays are NumPy float64 and SI unless a name
or a text says otherwise; units stand in names (`dp_pa`, `q_m3s`), shapes in brackets. Every error
that a user can meet derives from `rtid.errors.RtidError`. [story.ipynb](story.ipynb) uses most of
this on one machine.
"""


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for title, names in SECTIONS.items():
        parts.append(f"## {title}\n")
        parts += ["\n".join(entry(name)) for name in names]
    return "\n".join(parts)


def entry(name: str) -> Iterator[str]:
    """Lines of one function or class, `module:object`."""
    module, _, plain = name.partition(":")
    thing = getattr(import_module(module), plain)
    yield f"### `{module}.{plain}`\n"
    if inspect.isclass(thing):
        if dataclasses.is_dataclass(thing):
            yield from _fields(thing)
        else:
            yield f"```python\n{signature(plain, thing)}\n```\n"
        yield text(thing)
        yield from _members(thing)
    else:
        yield f"```python\n{signature(plain, thing)}\n```\n"
        yield text(thing)


def signature(name: str, thing: Any) -> str:
    """The call as it is written; one argument per line where it is long."""
    signature_of = inspect.signature(thing)
    kept = [p for p in signature_of.parameters.values() if p.name != "self"]
    kept = [_plain(p) for p in kept]
    result = signature_of.return_annotation
    back = "" if result is signature_of.empty or inspect.isclass(thing) else f" -> {_type(result)}"
    line = f"{name}({', '.join(map(str, kept))}){back}"
    if len(line) <= 100:
        return line
    return f"{name}(\n" + "".join(f"    {p},\n" for p in kept) + f"){back}"


def text(thing: Any) -> str:
    """The docstring, with displayed formulas as they are."""
    return (inspect.getdoc(thing) or "").strip() + "\n"


def _fields(kind: type) -> Iterator[str]:
    rows = [f"{f.name}: {_type(f.type)}{_default(f)}" for f in dataclasses.fields(kind)]
    yield "```python\n" + "\n".join(rows) + "\n```\n"


def _default(item: dataclasses.Field[Any]) -> str:
    if item.default is dataclasses.MISSING or callable(item.default):
        return "" if item.default_factory is dataclasses.MISSING else " = ..."
    return f" = {_value(item.default)}"


def _value(default: Any) -> str:
    return json.dumps(default) if isinstance(default, str) else repr(default)


def _members(kind: type) -> Iterator[str]:
    """Public methods and properties, one line each: the first line of what they say."""
    rows = []
    for name, member in vars(kind).items():
        call = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if name.startswith("_") or not (inspect.isfunction(call) or isinstance(call, property)):
            continue
        words = text(call).splitlines()[0]
        heading = name if isinstance(call, property) else _call(name, call)
        rows.append(f"- `{heading}`: {words}")
    if rows:
        yield "\n".join(rows) + "\n"


def _call(name: str, call: Any) -> str:
    kept = [p for p in inspect.signature(call).parameters if p not in ("self", "cls")]
    return f"{name}({', '.join(kept)})"


def _plain(parameter: inspect.Parameter) -> inspect.Parameter:
    """Without the address of a default that is a function."""
    default = parameter.default
    if default is not parameter.empty:
        default = _Word("..." if callable(default) else _value(default))
    annotation = parameter.annotation
    if annotation is not parameter.empty:
        annotation = _Word(_type(annotation))
    return parameter.replace(default=default, annotation=annotation)


class _Word(str):
    """Shown without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def _type(annotation: Any) -> str:
    name = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return re.sub(r"\b(?:np|numpy)\.ndarray\b", "FloatArray", name)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
