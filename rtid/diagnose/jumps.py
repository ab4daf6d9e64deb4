"""Where a valve opens with a jump: a border of its map there, and no hysteresis about it.

A spool edge with square corners opens the last of its overlap at once, at a command that nobody
has declared.  Six terms miss as much of a step in a short interval as in a long one, until a border
lies on it.  Over an interval of the command, a step at w0 adds to what the terms follow

    s(dp) share(w > w0),     s(dp) = sign(dp) sqrt |dp|,

and w0 is where that explains most of what they miss, looked for nearer and nearer as long as that
clearly rises: of a slow command a border that is 4 mV off is crossed 40 ms too late.

The flow changes the moment that border is crossed, so blocks begin there at once: a working point
that stays in the block behind it until it is 5 % beyond left rho at 4.5, and 1.02 without, on a
border that was exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.diagnose.evidence import project
from rtid.diagnose.fit import Fit, columns_of_effects
from rtid.effects.law import Volumes
from rtid.estimator.misfit import Misfit
from rtid.estimator.orifice import root
from rtid.estimator.refine import cut, missing_commands
from rtid.estimator.track import pressure_drop
from rtid.model import Machine
from rtid.plain import FloatArray, IntArray

PLACES = 15  # steps that are tried at once in an interval, and again about the best of them
NEARER = 5  # times, each within an eighth of the reach before
CLEARLY = 20.0  # of chi2 that steps must explain more, for there to be any nearer
SHARE = 0.2  # of the best step's gain that one of another map must have


@dataclass(frozen=True)
class Jump:
    """A step of a map at w_v, give or take reach_v, in an interval from low_v to high_v."""

    edge: int
    w_v: float
    low_v: float
    high_v: float
    reach_v: float

    def nearer(self) -> list[Jump]:
        """Steps within its reach, each of which has less."""
        shares = np.linspace(-1.0, 1.0, PLACES + 2)[1:-1]
        at = np.clip(self.w_v + self.reach_v * shares, self.low_v, self.high_v)
        apart_v = self.reach_v * float(shares[1] - shares[0])
        return [replace(self, w_v=float(w), reach_v=apart_v) for w in at]


def cut_at_jumps(present: Fit, rest: Misfit) -> Machine:
    """The machine with a border where each map jumps, if it does; rest: what the maps miss."""
    model = present.declared
    explained, steps = _best(present, rest, _first_steps(model, rest))
    for _ in range(NEARER):
        before = explained
        explained, steps = _best(present, rest, [s for step in steps for s in step.nearer()])
        if explained < before + CLEARLY:
            break
    at: list[list[float]] = [[] for _ in model.edges]
    for step in steps:
        at[step.edge].append(step.w_v)
    machine = cut(model, at)
    return replace(machine, gates=replace(machine.gates, hysteresis=0.0))


def _first_steps(model: Machine, rest: Misfit) -> list[Jump]:
    """Steps all over the intervals of each map's command that miss most."""
    steps = []
    for i, (edge, worst) in enumerate(zip(model.edges, missing_commands(model, rest), strict=True)):
        for low, high in (map(float, edge.grid.u_v[k : k + 2]) for k in worst):
            steps += Jump(i, 0.5 * (low + high), low, high, 0.5 * (high - low)).nearer()
    return steps


def _best(present: Fit, rest: Misfit, steps: list[Jump]) -> tuple[float, list[Jump]]:
    """What the step of each map explains that explains most, and these: fair parts of the best."""
    if not steps:
        return 0.0, []
    gains = _gains(present, rest, steps)
    best: dict[int, tuple[float, Jump]] = {}
    for step, gain in zip(steps, gains, strict=True):
        if gain > best.get(step.edge, (SHARE * float(gains.max()), step))[0]:
            best[step.edge] = float(gain), step
    return sum(gain for gain, _ in best.values()), [step for _, step in best.values()]


def _gains(present: Fit, rest: Misfit, steps: list[Jump]) -> FloatArray:
    """What chi2 falls by with each step (steps,), the maps and the effects being free to follow."""
    rows, along = present.own_rows, _along(present, rest)
    known = columns_of_effects(present)
    given = [*known, *(_column(present, along, step) for step in steps)]
    s = project(rows, [rows.on_rows(g) for g in given]).schur
    n = present.first_given + len(known)
    inner = s[1:n, 1:n] + np.diag(np.maximum(1e-9 * np.diag(s)[1:n], 1e-300))
    left = s - s[:, 1:n] @ np.linalg.solve(inner, s[1:n])
    return np.asarray(left[0, n:] ** 2 / np.maximum(np.diag(left)[n:], 1e-300))


@dataclass(frozen=True)
class _Along:
    """An edge along the record (n - 1,): opening and by how much it moves, V, and mean sqrt(dp).

    place (n - 1,): its interval of the command, -1 where no block is met; owner: the map it shares.
    """

    owner: int
    opening: FloatArray
    moves: FloatArray
    root: FloatArray
    place: IntArray


def _along(present: Fit, rest: Misfit) -> list[_Along]:
    """Each edge along the record; rest: what the maps miss."""
    model, view, edges = present.model, present.view, []
    for i, edge in enumerate(model.edges):
        opening, cells = view.opening(i), rest.cells[:, i]
        moves = np.maximum(np.abs(np.gradient(opening)), 1e-9)
        place = np.where(cells < 0, -1, (cells - model.first_cells[i]) // edge.grid.shape[1])
        s = root(pressure_drop(model, edge, present.sent[:, 2:]))
        edges.append(_Along(model.owners[i], opening, moves, 0.5 * (s[1:] + s[:-1]), place))
    return edges


def _column(present: Fit, along: list[_Along], step: Jump) -> Volumes:
    """Volumes per interval (n - 1,) that a step of one sqrt(Pa) would add to each chamber."""
    view = present.view
    borders = present.model.edges[step.edge].grid.u_v
    interval = np.searchsorted(borders, step.low_v, side="right") - 1
    nothing = np.zeros(view.n - 1)
    flows = [nothing] * len(along)
    for i, edge in enumerate(along):
        if edge.owner == step.edge:
            here = np.flatnonzero(edge.place == interval)
            beyond = np.clip((edge.opening[here] - step.w_v) / edge.moves[here] + 0.5, 0.0, 1.0)
            flows[i] = nothing.copy()
            flows[i][here] = beyond * edge.root[here]
    chambers = range(len(present.model.chambers))
    return {c: view.into_chamber(c, flows) * view.dt_s for c in chambers}
