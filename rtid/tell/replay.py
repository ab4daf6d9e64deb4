"""What a replay tells, as a plain story: text with tables, JSON, pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from rtid.compare.comparison import Comparison
from rtid.estimator.flowmap import LEARNING, VALID, EdgeMap
from rtid.estimator.validity import Doubt, doubts_of
from rtid.model import NONE
from rtid.plain import plain
from rtid.study.compared import TraceComparison
from rtid.study.compared import as_json as compared_json
from rtid.study.kept_record import Replay
from rtid.tell import compared_tables as tables
from rtid.tell.axes import axes_of
from rtid.tell.charts.maps import maps, slices
from rtid.tell.charts.over_time import residual
from rtid.tell.story import FAINT, Story, Table
from rtid.units import CONVENTION, Scale, range_of, scale_of, with_unit

SCHEMA = 1
MAP_ROWS, MAP_COLUMNS = 8, 5  # of the printed table of one map


@contextmanager
def progress_bar(hidden: bool = False) -> Iterator[Callable[[str, float], None]]:
    """A bar on the terminal (none where there is none): call it with what is done and the share.

    It is drawn on stderr alone: what a command prints stays as it is.
    """
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True, markup=False, emoji=False)
    with Progress(
        *columns, console=console, transient=True, disable=hidden or not console.is_terminal
    ) as progress:
        task = progress.add_task("", total=1.0)

        def report(text: str, share: float) -> None:
            progress.update(task, description=text, completed=share)

        yield report


@dataclass(frozen=True)
class LearnedStory:
    """A replay with its maps held against the trace (see `rtid.study.compared`)."""

    compared: TraceComparison

    @property
    def result(self) -> Replay:
        """The replay."""
        return self.compared.replay

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """What was learned and cannot be."""
        fit = self.result.fit
        return doubts_of(fit.solution, fit.lag_s, fit.lag_sd_s)

    def as_json(self) -> dict[str, Any]:
        """Everything that the text says, SI units; a number that is none is null."""
        fit, trace = self.result.fit, self.result.trace
        solution = fit.solution
        names = [c.name for c in self.result.model.chambers]
        words: dict[str, Any] = plain(
            {
                "schema": SCHEMA,
                "trace": str(trace.path),
                "duration_s": trace.duration_s,
                "frames": None if trace.log is None else len(trace.log),
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
                "doubts": [asdict(doubt) for doubt in self.doubts],
                "maps": compared_json(self.compared)["maps"],
                "blocks": {e.name: _block_counts(e) for e in self.compared.flowmap.edges},
            }
        )
        return words

    def _offsets(self) -> list[str]:
        """Messages whose offset was estimated."""
        names = list(self.result.project.offset_tolerance_s)
        return names[: len(self.result.fit.offsets_s)]

    def draw(self, folder: Path, suffix: str) -> list[Path]:
        """Pictures of coverage, maps, slices and residual; the files written."""
        # matplotlib only where a picture is wanted
        from rtid.tell import stills  # noqa: PLC0415
        from rtid.tell.charts.coverage import coverage  # noqa: PLC0415

        folder.mkdir(parents=True, exist_ok=True)
        chunk = self.result.part(self.result.identification_s)
        flowmap, reference = self.compared.flowmap, self.compared.reference
        axes = axes_of(self.result.model)
        name = reference.name if reference else ""
        figures = {
            "coverage": coverage(self.result.model, flowmap, chunk),
            "maps": stills.draw(maps(flowmap, axes=axes)),
            "slices": stills.draw(slices(flowmap, reference, None, name, axes)),
            "residual": stills.draw(residual(self.result.model, self.compared.held[0].parts)),
        }
        return [stills.save(f, folder / f"{name}.{suffix}") for name, f in figures.items()]

    @property
    def story(self) -> Story:
        """The trace, what was learned of it, and the maps."""
        doubts = [doubt.text for doubt in self.doubts]
        maps = [self._map_table(edge) for edge in self.compared.flowmap.edges]
        return Story(
            "",
            (
                *self._trace(),
                *self._parameters(),
                *self._grids(),
                *doubts,
                self._residual(),
                tables.samples([self.compared]),
                self._blocks(),
                *maps,
            ),
        )

    def _trace(self) -> Iterator[str]:
        trace, counters = self.result.trace, self.result.live.counters
        rate = (len(trace.samples) - 1) / max(trace.duration_s, 1e-9)
        frames = "" if trace.log is None else f"{len(trace.log):,} frames, "
        yield (
            f"{trace.path.name}: {trace.duration_s:.1f} s, {frames}"
            f"{len(trace.samples):,} samples ({rate:.0f} per second)"
        )
        refused = {k: v for k, v in trace.counters.items() if v}
        quiet = ("samples", "rows", "block_changes")
        gates = {k: v for k, v in counters.items() if v and k not in quiet}
        yield f"refused by the bridge: {_counts(refused)}"
        yield f"stopped by the gates:  {_counts(gates)}"

    def _parameters(self) -> Iterator[str]:
        fit, model = self.result.fit, self.result.model
        solution, pressure, time = fit.solution, scale_of("Pa"), scale_of("s")
        for chamber, beta, sd in zip(
            model.chambers, solution.beta_pa, solution.beta_sd_pa, strict=True
        ):
            if not chamber.pressure:
                continue
            known = pressure.known(beta, sd, 1)
            yield f"bulk modulus, chamber {chamber.name}: {known} {pressure.name}"
        if fit.lag_sd_s > 0:
            yield (
                f"spool lag: {time.known(fit.lag_s, fit.lag_sd_s, 2)} {time.name} "
                f"({_declared(model.lag.nominal_s, model.lag.tolerance_s)})"
            )
        for name, shift, sd in zip(self._offsets(), fit.offsets_s, fit.offsets_sd_s, strict=True):
            yield f"message {name}: {time.known(shift, sd, 2)} {time.name} beyond its age"
        yield CONVENTION

    def _grids(self) -> Iterator[str]:
        """Grids that the record needed finer than declared."""
        for edge, used in zip(self.result.declared.maps, self.result.model.maps, strict=True):
            (nu, nd), (mu, md) = edge.grid.shape, used.grid.shape
            if (nu, nd) != (mu, md):
                yield (
                    f"grid of {edge.name}: {mu} x {md} blocks instead of {nu} x {nd}, halved where "
                    "a block's terms missed the flow"
                )

    def _residual(self) -> Table:
        chambers = [f"chamber {c.name}|" for c in self.result.model.chambers]
        rows = [
            (kept.name, name, *_left(part))
            for kept in self.compared.held
            for name, part in kept.parts.items()
        ]
        title = "what the model leaves of the measured flow (rms)"
        return Table(title, ("map", "part", *chambers, "x sensor noise|"), rows, keys=2)

    def _blocks(self) -> Table:
        known, rows = (VALID, LEARNING, "extrapolated"), []
        for edge in self.compared.flowmap.edges:
            counts = _block_counts(edge)
            rest = sum(n for word, n in counts.items() if word not in known)
            cells = [str(counts.get(word, 0)) for word in known]
            rows.append((edge.name, *cells, str(rest), with_unit(edge.q_max_m3s, "m3/s")))
        heads = ("edge", *(f"{k}|" for k in known), "no data|", "largest flow, valid|")
        return Table("blocks of the maps", heads, rows)

    def _map_table(self, edge: EdgeMap) -> Table:
        """One map as a table of flow ± 95 % where it has data, the reference beside it."""
        i, j = np.nonzero((edge.status == VALID) | (edge.status == LEARNING))
        if len(i) == 0:
            return Table("", (), ())
        u = _spread(edge.grid.u_v, i, MAP_ROWS)
        dp = _spread(edge.grid.dp_pa, j, MAP_COLUMNS)
        scale, drop = scale_of("m3/s"), scale_of("Pa")
        beside = "" if self.compared.reference is None else " | reference"
        title = f"{edge.name}: flow ±{beside} in {scale.name}   (~ not known well enough yet)"
        declared = next(e for e in self.result.model.edges if e.name == edge.name)
        axes = self.result.model.axes(declared)
        heads = ("u \\ dp|", *(f"{drop.number(p, 2)} {drop.name}|" for p in dp))
        if axes.over == NONE:
            heads = ("u|", f"{scale.name}|")
        elif axes.over is not None:
            heads = (f"u \\ {axes.over}|", *(f"{p:.4g}|" for p in dp))
        flows = None
        if self.compared.reference is not None:
            points = np.meshgrid(u, dp, indexing="ij")
            flows = self.compared.reference.flow(edge.name, *points)
        rows = []
        for a, w in enumerate(u):
            row = None if flows is None else flows[a]
            cells = _map_cells(scale, edge, np.full(len(dp), w), dp, row)
            rows.append((f"{w:.2f} {axes.command}", *cells))
        return Table(title, heads, rows)


def _declared(nominal_s: float, tolerance_s: float) -> str:
    return f"declared {range_of(nominal_s - tolerance_s, nominal_s + tolerance_s, 's')}"


def _map_cells(scale: Scale, edge: EdgeMap, w: Any, dp: Any, beside: Any) -> list[str]:
    flow, sd, status = edge.flow(w, dp), edge.sd(w, dp), edge.status_at(w, dp)
    cells: list[str] = []
    for k in range(len(dp)):
        text = scale.known(flow[k], sd[k], 2)
        if beside is not None and np.isfinite(beside[k]):
            text += f" | {scale.number(beside[k], 2)}"
        cells.append(text if status[k] == VALID else f"{FAINT}{text}")
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
    flow = scale_of("m3/s")
    cells = [f"{flow.number(rms, 3)} {flow.name} = {100 * share:.2f} %" for rms, share in both]
    return [*cells, f"{float(np.mean(part.rho)):.2f}"]


def _block_counts(edge: EdgeMap) -> dict[str, int]:
    return dict(Counter(edge.status.ravel().tolist()))


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{k.replace('_', ' ')} {v:,}" for k, v in counts.items()) or "nothing"
