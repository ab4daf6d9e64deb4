"""Write the speed table of docs/figures.md between its markers, from what `make bench` measured.

python -m benchmarks.table [MEASURED.json docs/figures.md]
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def human_time(seconds: float) -> str:
    """Three digits and the unit that suits: 31.4 ns, 5.30 us, 12.0 ms, 1.25 s."""
    for limit, factor, unit in ((1e-6, 1e9, "ns"), (1e-3, 1e6, "us"), (1.0, 1e3, "ms")):
        if seconds < limit:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds:.3g} s"


def _lines(runs: list[dict[str, Any]]) -> Iterator[str]:
    yield "| | time | ratio | asked |"
    yield "|---|---|---|---|"
    for run in runs:
        info = run["extra_info"]
        yield f"| **{info['title']}** | per {info['unit']} | | |"
        for row in info["rows"]:
            time = row.get("text") or human_time(row["seconds"])
            times = f"{row['ratio']:.3g} x" if "ratio" in row else ""
            yield f"| {row['name']} | {time} | {times} | {row.get('asked', '')} |"


def markdown(measured: dict[str, Any]) -> str:
    """Table of all benchmarks that ran, and the machine they ran on."""
    machine = measured["machine_info"]
    cpu = machine["cpu"].get("brand_raw", machine["machine"])
    head = (
        f"Measured by `make bench` on {cpu}, Python {machine['python_version']}; every group was "
        "timed interleaved in one run, times are of the processor, ratios are medians over the "
        "rounds. Asked: at most so much time, memory or multiple of the first row; of other "
        "libraries and of real time at least so many times.\n"
    )
    return "\n".join([head, *_lines([r for r in measured["benchmarks"] if r["extra_info"]])])


def replace_between(text: str, name: str, content: str) -> str:
    """Text with everything between the markers <!-- name:begin --> and end replaced."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, rest = text.split(begin)
    return f"{before}{begin}\n{content}\n{end}{rest.split(end)[1]}"


def main(arguments: list[str]) -> None:
    """Read the measurement, rewrite the page."""
    source, target = arguments or ("out/bench.json", "docs/figures.md")
    table = markdown(json.loads(Path(source).read_text()))
    readme = Path(target)
    readme.write_text(replace_between(readme.read_text(), "speed", table))
    print(f"{target}: speed table written")


if __name__ == "__main__":
    main(sys.argv[1:])
