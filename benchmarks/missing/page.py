"""The tables of docs/benchmark.md between their markers, and its picture, from what was measured.

    python -m benchmarks.missing.page out/missing/2026/result.json [ANOTHER SEED'S ...]

The first result fills the tables; another one is only held against it: the rank correlation
(Spearman) of the methods' errors on the records of the kinds that both have.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from scipy.stats import spearmanr

from benchmarks.missing.record import OUTSIDE
from benchmarks.missing.score import (
    ALARM,
    AMONG,
    FAILED,
    IN_SET,
    QUIET,
    RIGHT,
    SILENT,
    UNKNOWN_WORD,
    WRONG,
)
from benchmarks.table import replace_between
from tools.readme_pictures import shrink

ROOT = Path(__file__).parents[2]
PAGE, PICTURE = ROOT / "docs" / "benchmark.md", ROOT / "tools" / "pictures" / "benchmark.png"
EQUATIONS = "equations"
AWAY, TURNS = (10, 20, 32, 48, 64), np.radians([0, 20, -20, 160, 200, 50, -50, 130, -130])
LEADER = {"arrowstyle": "-", "lw": 0.5, "color": "0.5"}
OURS = ("rtid", "rtid, map alone")
Line = dict[str, Any]
Keep = Callable[[Line], bool]
NAMED = (RIGHT, IN_SET, AMONG, SILENT, UNKNOWN_WORD, WRONG, FAILED)


class Measured:
    """A result: its lines joined with their cases."""

    def __init__(self, path: Path) -> None:
        self.whole: dict[str, Any] = json.loads(path.read_text())
        cases = self.whole["cases"]
        self.lines: list[Line] = [cases[r["case"]] | r for r in self.whole["results"]]

    def methods(self, lines: list[Line]) -> list[str]:
        """Of these lines, in the order of the run."""
        return [m for m in self.whole["methods"] if any(r["method"] == m for r in lines)]

    def where(self, keep: Keep) -> list[Line]:
        """Some of them."""
        return [line for line in self.lines if keep(line)]


def valves_for_all(line: Line) -> bool:
    """Records of valves that every method has taken."""
    return bool(line["for_all"]) and line["simulator"] != EQUATIONS


def common(lines: list[Line]) -> list[Line]:
    """Those of the records that every method in them has done."""
    methods = {r["method"] for r in lines}
    done = Counter(r["case"] for r in lines)
    return [r for r in lines if done[r["case"]] == len(methods)]


def median(lines: list[Line], key: str) -> float:
    """Over records; a method that broke off has an infinite error there, NaN: nobody answers."""
    values = [line[key] for line in lines]
    if key == "unseen":
        values = [np.inf if v is None else v for v in values]
    values = [v for v in values if v is not None]
    return float(np.median(values)) if values else float("nan")


def mean(lines: list[Line], key: str) -> float:
    """Over the records that have an answer."""
    values = [line[key] for line in lines if line[key] is not None]
    return float(np.mean(values)) if values else float("nan")


def percent(value: float) -> str:
    """A share in per cent with two digits, a dash for nothing."""
    if np.isnan(value):
        return "–"
    return f"{100 * value:.2g}" if value < 1.0 else f"{100 * value:.0f}" if value < 100 else "∞"


def table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    """A table in markdown."""
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(row) + " |"
    yield ""


def of_maps(measured: Measured) -> Iterator[str]:
    """The first table: maps and predictions of the records that all methods take."""
    lines = common(measured.where(valves_for_all))
    parts: dict[str, Keep] = {
        "rich": lambda r: r["motion"] == "rich" and not r["hidden"],
        "poor": lambda r: r["motion"] != "rich",
        "leak": lambda r: bool(r["hidden"]),
    }
    counts = {name: len({r["case"] for r in lines if keep(r)}) for name, keep in parts.items()}
    yield (
        f"Medians over {counts['rich']} records of rich motion, {counts['poor']} of poor motion "
        f"(a slow sweep), and {counts['leak']} with a strong hidden leak; map, modulus, times over "
        "the clean ones."
    )
    yield ""
    rows = []
    for method in measured.methods(lines):
        of = [r for r in lines if r["method"] == method]
        clean = [r for r in of if not r["hidden"]]
        unseen = [percent(median([r for r in of if keep(r)], "unseen")) for keep in parts.values()]
        cover = [percent(mean(clean, key)) for key in ("map_cover", "beta_cover")]
        errors = [percent(median(clean, key)) for key in ("map_error", "beta_error")]
        time_s = median(clean, "learn_s")
        memory = max((r["memory_mib"] for r in of if r.get("memory_mib") is not None), default=None)
        broke = sum(bool(r["failed"]) for r in of)
        name = f"**{method}**" if method in OURS else method
        name += f" (broke off {broke} times)" if broke else ""
        rows.append(
            [
                name,
                *unseen,
                *errors,
                *cover,
                f"{time_s:.2g}",
                "–" if memory is None else f"{memory:.0f}",
            ]
        )
    rows.sort(key=lambda row: _number(row[1]))
    head = ["method", "unseen, rich, %", "unseen, poor, %", "unseen, leak, %", "map, %", "beta, %",
            "map in its 95 %", "beta in its 95 %", "time, s", "memory, MiB"]  # fmt: skip
    yield from table(head, rows)


def _number(text: str) -> float:
    return {"–": 1e9, "∞": 1e8}.get(text) or float(text)


def of_names(measured: Measured) -> Iterator[str]:
    """The second table: what is missing, and what was said of it."""
    lines = measured.where(lambda r: r["judgement"] != "" and r["simulator"] != EQUATIONS)
    lines = common(lines)
    methods = measured.methods(lines)
    listed = [r for r in lines if r["effect"] and r["effect"] != OUTSIDE]
    groups = {
        "a listed effect": listed,
        "weak": [r for r in listed if r["level"] == "weak"],
        "middle": [r for r in listed if r["level"] == "middle"],
        "strong": [r for r in listed if r["level"] == "strong"],
        "an unlisted effect": [r for r in lines if r["effect"] == OUTSIDE],
    }
    rows = []
    for group, members in groups.items():
        for method in methods if members else ():
            of = [r for r in members if r["method"] == method]
            count = Counter(r["judgement"] for r in of)
            row = [str(count[j] or "") for j in NAMED]
            first = group if method == methods[0] else ""
            rows.append([first, method, str(len(of)), *row, percent(median(of, "unseen"))])
    yield from table(["hidden", "method", "records", *NAMED, "unseen, %"], rows)
    rows = []
    for method in methods:
        of = [r for r in lines if r["method"] == method and not r["effect"]]
        count = Counter(r["judgement"] for r in of)
        rows.append(
            [method, str(len(of)), str(count[QUIET]), str(count[ALARM]), str(count[FAILED])]
        )
    yield from table(["nothing is missing in the valves", "records", QUIET, ALARM, FAILED], rows)


def of_simulators(measured: Measured) -> Iterator[str]:
    """Error on unseen motion by who has simulated, clean records."""
    lines = common(measured.where(lambda r: valves_for_all(r) and not r["hidden"]))
    simulators = list(dict.fromkeys(r["simulator"] for r in lines))
    rows = []
    for method in measured.methods(lines):
        of = [r for r in lines if r["method"] == method]
        cells = [percent(median([r for r in of if r["simulator"] == s], "unseen"))
                 for s in simulators]  # fmt: skip
        rows.append([method, *cells])
    yield from table(["unseen, %", *simulators], rows)


def of_equations(measured: Measured) -> Iterator[str]:
    """Plants by equations: free run on other inputs, in per cent of the output's spread."""
    lines = common(measured.where(lambda r: r["simulator"] == EQUATIONS))
    kinds = sorted({(r["law"], bool(r["hidden"])) for r in lines})
    rows = []
    for method in measured.methods(lines):
        of = [r for r in lines if r["method"] == method]
        cells = []
        for law, hidden in kinds:
            here = [r for r in of if r["law"] == law and bool(r["hidden"]) == hidden]
            cells.append(percent(median(here, "unseen")))
        names = Counter(r["judgement"] for r in of if r["judgement"])
        said = ", ".join(f"{n} {word}" for word, n in names.items()) or "–"
        rows.append([method, *cells, said, f"{median(of, 'learn_s'):.2g}"])
    heads = [f"{law}, {'hidden' if hidden else 'clean'}" for law, hidden in kinds]
    yield from table(["free run, %", *heads, "names", "time, s"], rows)


def of_losses(measured: Measured) -> Iterator[str]:
    """Records on which another method is as good as rtid or better, by what is measured."""
    keys = {"unseen": "unseen", "map_error": "map", "beta_error": "beta"}
    rows, asked = [], Counter[str]()
    for case in dict.fromkeys(r["case"] for r in measured.lines):
        for key, word in keys.items():
            of = {r["method"]: r[key] for r in measured.lines if r["case"] == case}
            peers = {m: v for m, v in of.items() if m not in OURS and v is not None}
            if of.get("rtid") is None or not peers:
                continue
            asked[word] += 1
            best = min(peers, key=lambda m: peers[m])
            if peers[best] <= of["rtid"]:
                rows.append([case.replace("_", " "), word, best, percent(peers[best]),
                             percent(of["rtid"])])  # fmt: skip
    lost = Counter(row[1] for row in rows)
    yield "; ".join(f"{word}: {lost[word]} of {n} records" for word, n in asked.items()) + "."
    yield ""
    yield from table(["record", "what", "best peer", "its error, %", "rtid's, %"], rows)


def ranks(first: Measured, second: Measured) -> tuple[list[str], float]:
    """Methods of both, and the rank correlation of their median errors on like records."""
    kinds = {(r["simulator"], r["motion"]) for r in second.lines if valves_for_all(r)}

    def like(line: Line) -> bool:
        return valves_for_all(line) and (line["simulator"], line["motion"]) in kinds

    lines = [common(m.where(lambda r: like(r) and not r["hidden"])) for m in (first, second)]
    both = [m for m in first.methods(lines[0]) if m in second.methods(lines[1])]
    errors = [[median([r for r in of if r["method"] == m], "unseen") for m in both] for of in lines]
    return both, float(spearmanr(np.array(errors[0]), np.array(errors[1])).statistic)


def of_seeds(first: Measured, others: list[Measured]) -> Iterator[str]:
    """The order of the methods on other seeds."""
    if not others:
        yield "For this page one seed was measured."
    for other in others:
        methods, rho = ranks(first, other)
        seeds = first.whole["seed"], other.whole["seed"]
        yield (
            f"Seed {seeds[0]} beside seed {seeds[1]}: rank correlation {rho:.2f} of the median "
            f"error on unseen motion, {len(methods)} methods, the kinds of records that both have."
        )
        yield ""


def picture(measured: Measured, path: Path) -> None:
    """Error on unseen motion against processor time, one point per method."""
    lines = common(measured.where(lambda r: valves_for_all(r) and not r["hidden"]))
    figure, axes = plt.subplots(figsize=(8.4, 4.8))
    axes.set(xscale="log", yscale="log", xlabel="processor time to learn 32 s of record, s",
             ylabel="error on unseen motion, % of the flow")  # fmt: skip
    axes.grid(alpha=0.3, which="both")
    axes.margins(0.14)
    points: dict[str, tuple[float, float]] = {}
    for method in measured.methods(lines):
        of = [r for r in lines if r["method"] == method]
        points[method] = max(median(of, "learn_s"), 1e-2), 100 * median(of, "unseen")
        ours = method in OURS
        axes.plot(*points[method], "k*" if ours else "C0o", ms=12 if ours else 5)
    _label(axes, points)
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)


def _label(axes: Axes, points: dict[str, tuple[float, float]]) -> None:
    """Each name at the nearest place, AWAY points off, that nothing else has taken."""
    renderer = axes.figure.canvas.get_renderer()  # type: ignore[attr-defined]
    axes.figure.draw(renderer)
    taken = [Bbox.from_bounds(x - 7, y - 7, 14, 14)
             for x, y in axes.transData.transform(list(points.values()))]  # fmt: skip
    for method, at in points.items():
        for far, turn in product(AWAY, TURNS):
            offset, leader = (far * np.cos(turn), far * np.sin(turn)), far > AWAY[0]
            text = axes.annotate(
                method, at, offset, textcoords="offset points", fontsize=8, va="center",
                ha="left" if offset[0] > 0 else "right", arrowprops=LEADER if leader else None,
            )  # fmt: skip
            text.update_positions(renderer)
            box = Text.get_window_extent(text)  # without its leader
            inside = axes.bbox.x0 < box.x0 and box.x1 < axes.bbox.x1
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            text.remove()


def head(measured: Measured) -> Iterator[str]:
    """What it was measured by."""
    w = measured.whole
    total_s = sum(r["learn_s"] + r["judge_s"] for r in w["results"])
    packages = ", ".join(f"{name} {version}" for name, version in w["versions"].items())
    asked = len({r["case"] for r in w["results"]})
    methods = len({r["method"] for r in w["results"]})
    yield (
        f"Measured by `make benchmark-missing`, seed {w['seed']}: {asked} of the {len(w['cases'])} "
        f"records that were drawn, {methods} methods, {total_s / 60:.0f} minutes of processor time "
        f"on one thread of {w['processor']}, Python {w['python']}; {packages}."
    )
    lacking = [m for m in w["methods"] if m not in {r["method"] for r in w["results"]}]
    if lacking:
        yield ""
        yield f"Not in this measurement, for want of processor time: {', '.join(lacking)}."
    yield ""


def main(paths: list[Path]) -> None:
    """Fill the page and draw the picture."""
    first, *others = (Measured(path) for path in paths)
    text = PAGE.read_text()
    parts = {
        "head": head(first), "maps": of_maps(first), "names": of_names(first),
        "simulators": of_simulators(first), "equations": of_equations(first),
        "losses": of_losses(first), "seeds": of_seeds(first, others),
    }  # fmt: skip
    for name, lines in parts.items():
        text = replace_between(text, f"benchmark {name}", "\n".join(lines).rstrip())
    PAGE.write_text(text)
    large = paths[0].with_name("picture.png")
    picture(first, large)
    shrink(large, PICTURE)


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
