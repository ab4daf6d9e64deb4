"""Each fault prints its figure, and leaves it in $RTID_FAULTS for the table of `make faults`."""

from __future__ import annotations

import json
import os
from collections.abc import Callable

import pytest

Figure = Callable[..., None]


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Figure:
    """`figure(row, what, value, most, unit)`: note a figure, and fail where it is above `most`.

    least: the other bound.
    """

    def note(
        row: int,
        what: str,
        value: float,
        most: float | None = None,
        unit: str = "",
        least: float | None = None,
    ) -> None:
        value = float(value)  # numpy's numbers are no JSON
        met = (most is None or value <= most) and (least is None or value >= least)
        wanted = f"<= {most:g}" if most is not None else ""
        wanted += f">= {least:g}" if least is not None else ""
        print(f"\nfault {row}: {what}: {value:.6g} {unit} (wanted {wanted} {unit})")
        if path := os.environ.get("RTID_FAULTS"):
            entry = {"row": row, "what": what, "value": value, "wanted": wanted, "unit": unit}
            with open(path, "a", encoding="utf-8") as file:
                file.write(json.dumps(entry | {"met": met, "test": request.node.nodeid}) + "\n")
        assert met, f"{what}: {value:.6g} {unit}, wanted {wanted} {unit}"

    return note
