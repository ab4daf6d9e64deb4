"""What a replay tells, as a plain story: text with tables, JSON, pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from rtid.compare.comparison import Comparison
from rtid.comparing import TraceComparison
from rtid.comparing import as_json as compared_json
from rtid.estimator.flowmap import LEARNING, VALID, EdgeMap
from rtid.replay import Replay
from rtid.units import LPM, MPA

SCHEMA = 1
WIDTH = 110  # where the output is no terminal
Z95 = 1.96
MAP_ROWS, MAP_COLUMNS = 8, 5  # of the printed table of one map


@contextmanager
def progress_bar(hidden: bool) -> Iterator[Callable[[str, float], None]]:
    """A bar on the terminal (none where there is none): call it with what is done and the share."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=hidden) as progress:
        task = progress.add_task("", total=1.0)

        def report(text: str, share: float) -> None:
            progress.update(task, description=text, completed=share)

        yield report


@dataclass(frozen=True)
class Story:
    """A replay with its maps held against the trace (see `rtid.comparing`)."""

    compared: TraceComparison

    @property
    def result(self) -> Replay:
        """The replay."""
        return self.compared.replay

    def as_json(self) -> dict[str, Any]:
        """Everything that the text says, SI units."""
        fit, trace = self.result.fit, self.result.trace
        solution = fit.solution
        names = [c.name for c in self.result.model.chambers]
        return {
            "schema": SCHEMA,
            "trace": str(trace.path),
            "duration_s": trace.duration_s,
            "frames": None if trace.frames is None else len(trace.frames),
            "samples": len(trace.samples),
            "refused": trace.counters,
            "gates": self.result.live.counters,
            "beta_pa": dict(zip(names, solution.beta_pa.tolist(), strict=True)),
            "beta_sd_pa": dict(zip(names, solution.beta_sd_pa.tolist(), strict=True)),
            "lag_s": fit.lag_s,
            "lag_sd_s": fit.lag_sd_s,
            "offset_changes_s": dict(zip(self._offsets(), fit.offsets_s.tolist(), strict=True)),
            "offset_sd_s": dict(zip(self._offsets(), fit.offsets_sd_s.tolist(), strict=True)),
            "rho": solution.rho,
            "maps": compared_json(self.compared)["maps"],
            "blocks": {e.name: _block_counts(e) for e in self.compared.flowmap.edges},
        }

    def _offsets(self) -> list[str]:
        """Messages whose offset was estimated."""
        names = list(self.result.project.offset_tolerance_s)
        return names[: len(self.result.fit.offsets_s)]

    def draw(self, folder: Path, suffix: str) -> list[Path]:
        """Pictures of coverage, maps, slices and residual; the files written."""
        from rtid import pictures  # noqa: PLC0415 - matplotlib only where a picture is wanted

        folder.mkdir(parents=True, exist_ok=True)
        chunk = self.result.part(self.result.identification_s)
        flowmap, reference = self.compared.flowmap, self.compared.reference
        name = reference.name if reference else ""
        figures = {
            "coverage": pictures.coverage(self.result.model, flowmap, chunk),
            "maps": pictures.maps(flowmap),
            "slices": pictures.slices(flowmap, reference, reference_name=name),
            "residual": pictures.residual(self.result.model, self.compared.held[0].parts),
        }
        return [pictures.save(f, folder / f"{name}.{suffix}") for name, f in figures.items()]

    def print(self, snapshot: Path | None = None, pictures: list[Path] | None = None) -> None:
        """Tell the story on the terminal."""
        console = Console()
        console = console if console.is_terminal else Console(width=WIDTH)
        self._print_trace(console)
        self._print_parameters(console)
        self._print_residual(console)
        self._print_blocks(console)
        for edge in self.compared.flowmap.edges:
            if table := self._map_table(edge):
                console.print(table)
        for path in [*([snapshot] if snapshot else []), *(pictures or [])]:
            console.print(f"wrote {path}", highlight=False)

    def _print_trace(self, console: Console) -> None:
        trace, counters = self.result.trace, self.result.live.counters
        rate = (len(trace.samples) - 1) / max(trace.duration_s, 1e-9)
        frames = "" if trace.frames is None else f"{len(trace.frames):,} frames, "
        console.print(
            f"[bold]{trace.path.name}[/bold]: {trace.duration_s:.1f} s, {frames}"
            f"{len(trace.samples):,} samples ({rate:.0f} per second)",
            highlight=False,
        )
        refused = {k: v for k, v in trace.counters.items() if v}
        quiet = ("samples", "rows", "block_changes")
        gates = {k: v for k, v in counters.items() if v and k not in quiet}
        console.print(f"refused by the bridge: {_counts(refused)}", highlight=False)
        console.print(f"stopped by the gates:  {_counts(gates)}", highlight=False)

    def _print_parameters(self, console: Console) -> None:
        fit, model = self.result.fit, self.result.model
        solution = fit.solution
        for chamber, beta, sd in zip(
            model.chambers, solution.beta_pa, solution.beta_sd_pa, strict=True
        ):
            console.print(
                f"bulk modulus, chamber {chamber.name}: [bold]{beta * MPA:.1f} MPa[/bold] "
                f"± {Z95 * sd * MPA:.1f} (95 %)",
                highlight=False,
            )
        if fit.lag_sd_s > 0:
            console.print(
                f"spool lag: {fit.lag_s * 1e3:.2f} ms ± {Z95 * fit.lag_sd_s * 1e3:.2f} "
                f"(declared {model.lag.nominal_s * 1e3:g} +- {model.lag.tolerance_s * 1e3:g})",
                highlight=False,
            )
        for name, shift, sd in zip(self._offsets(), fit.offsets_s, fit.offsets_sd_s, strict=True):
            console.print(
                f"message {name}: {shift * 1e3:+.2f} ms ± {Z95 * sd * 1e3:.2f} beyond its age",
                highlight=False,
            )

    def _print_residual(self, console: Console) -> None:
        table = Table(
            title="what the model leaves of the measured flow (rms)", title_justify="left"
        )
        for head in ("map", "part", *(f"chamber {c.name}" for c in self.result.model.chambers)):
            table.add_column(head)
        table.add_column("x sensor noise")
        for held in self.compared.held:
            for name, part in held.parts.items():
                table.add_row(held.name, name, *_left(part))
        console.print(table)

    def _print_blocks(self, console: Console) -> None:
        table = Table(title="blocks of the maps", title_justify="left")
        for head in ("edge", "valid", "learning", "extrapolated", "no data", "largest flow, valid"):
            table.add_column(head, justify="left" if head == "edge" else "right")
        for edge in self.compared.flowmap.edges:
            counts = _block_counts(edge)
            known = (VALID, LEARNING, "extrapolated")
            rest = sum(n for word, n in counts.items() if word not in known)
            cells = [str(counts.get(word, 0)) for word in known]
            table.add_row(edge.name, *cells, str(rest), f"{edge.q_max_m3s * LPM:.1f} L/min")
        console.print(table)

    def _map_table(self, edge: EdgeMap) -> Table | None:
        """One map as a table of flow +- 95 % where it has data, the reference beside it."""
        i, j = np.nonzero((edge.status == VALID) | (edge.status == LEARNING))
        if len(i) == 0:
            return None
        u = _spread(edge.grid.u_v, i, MAP_ROWS)
        dp = _spread(edge.grid.dp_pa, j, MAP_COLUMNS)
        beside = "" if self.compared.reference is None else " | reference"
        title = f"{edge.name}: flow in L/min ±95 %{beside}   (~ not known well enough yet)"
        table = Table(title=title, title_justify="left")
        table.add_column("u \\ dp", justify="right")
        for p in dp:
            table.add_column(f"{p * MPA:.2f} MPa", justify="right")
        flows = None
        if self.compared.reference is not None:
            points = np.meshgrid(u, dp, indexing="ij")
            flows = self.compared.reference.flow(edge.name, *points)
        for a, w in enumerate(u):
            row = None if flows is None else flows[a]
            table.add_row(f"{w:.2f} V", *_map_cells(edge, np.full(len(dp), w), dp, row))
        return table


def _map_cells(edge: EdgeMap, w: Any, dp: Any, beside: Any) -> list[str]:
    flow, sd, status = edge.flow(w, dp), edge.sd(w, dp), edge.status_at(w, dp)
    cells = []
    for k in range(len(dp)):
        text = f"{flow[k] * LPM:.2f} ±{Z95 * sd[k] * LPM:.2f}"
        if beside is not None and np.isfinite(beside[k]):
            text += f" | {beside[k] * LPM:.2f}"
        cells.append(text if status[k] == VALID else f"[dim]~{text}[/dim]")
    return cells


def _spread(border: Any, used: Any, most: int) -> Any:
    """At most so many centres of the intervals that hold data, evenly spread."""
    centres = 0.5 * (border[1:] + border[:-1])
    index = np.unique(used)
    pick = np.unique(np.linspace(0, len(index) - 1, min(most, len(index))).round().astype(int))
    return centres[index[pick]]


def _left(part: Comparison) -> list[str]:
    """Residual per chamber, and in units of the noise; dashes for a part without rows."""
    if not len(part.t_s):
        return ["-"] * (part.residual_m3s.shape[1] + 1)
    both = zip(part.residual_rms_m3s, part.residual_share, strict=True)
    cells = [f"{rms * LPM:.3f} L/min = {100 * share:.2f} %" for rms, share in both]
    return [*cells, f"{float(np.mean(part.rho)):.2f}"]


def _block_counts(edge: EdgeMap) -> dict[str, int]:
    return dict(Counter(edge.status.ravel().tolist()))


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{k.replace('_', ' ')} {v:,}" for k, v in counts.items()) or "nothing"
