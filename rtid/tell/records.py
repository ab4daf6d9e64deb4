"""What a model leaves of each of several records that one fit is made of."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rtid.units import flow_name, lpm

if TYPE_CHECKING:
    from rtid.study.study import RecordError


def record_lines(errors: Sequence[RecordError]) -> Iterator[str]:
    """A line for each record: taught or held out, and its error; none of one record."""
    if errors:
        yield "\nrecords of this fit, and what it leaves of each (rms)"
    width = max((len(error.path.name) for error in errors), default=0)
    for error in errors:
        part = "held out" if error.is_held_out else "taught"
        share = 100 * error.left / error.flow if error.flow else float("nan")
        left = f"{lpm() * error.left:.4g} {flow_name()} = {share:.3g} %"
        if math.isfinite(error.run):
            left += f", free run off by {lpm() * error.run:.3g} {_state_unit()}"
        yield f"  {error.path.name:{width}}  {part:8}  {left}"


def _state_unit() -> str:
    """Of what the plant's rate is the rate of: mm of mm/s, m/s of m/s2."""
    name = flow_name()
    return name.removesuffix("2") if name.endswith("/s2") else name.removesuffix("/s")


def records_json(errors: Sequence[RecordError]) -> dict[str, Any]:
    """The same as plain JSON types; nothing of one record."""
    rows = [
        {
            "file": str(error.path),
            "held_out": error.is_held_out,
            "residual_rms": error.left,
            "flow_rms": error.flow,
        }
        | ({"free_run_rms": error.run} if math.isfinite(error.run) else {})
        for error in errors
    ]
    return {"records": rows} if rows else {}
