"""A model as it stands: the one fit of a record, and every candidate beside it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from rtid.diagnose.clean import as_measured, usable
from rtid.diagnose.excuse import few_excused
from rtid.diagnose.finer import fine_enough, halved_throughout
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.lag_interval import looked_over
from rtid.diagnose.parts import AddedEffect, recall
from rtid.diagnose.residual import Residual, residual
from rtid.diagnose.spread import with_spreads
from rtid.diagnose.trials import TrialState
from rtid.effects.page import Effect
from rtid.estimator.factor import on_one_thread
from rtid.model import Machine
from rtid.plain import FloatArray, Progress, silent


@dataclass(frozen=True)
class Standing:
    """A model on a record, every candidate beside it, and what it leaves of both parts."""

    state: TrialState
    fit: Fit

    @cached_property
    def identification(self) -> Residual:
        """What it leaves of the part that teaches."""
        return residual(self.fit, self.state.chunk)

    @cached_property
    def held_out(self) -> Residual:
        """What it leaves of the part that judges."""
        return residual(self.fit, self.state.held_out)


@on_one_thread
def fitted(
    model: Machine,
    chunk: FloatArray,
    parts: tuple[AddedEffect, ...] = (),
    suspects: tuple[Effect, ...] = (),
) -> Fit:
    """The one fit of a model with its parts to a record, chunk (n, 2 + signals), SI.

    Replay, compare, export, diagnosis and page read this one; its `declared` has the grid that the
    record needs.  suspects: effects of the user's, of which parts may be.  Raises PartError where
    the record has no column for a part.
    """
    fine, rest = fine_enough(on_its_grid(model, chunk, parts, suspects))
    first = few_excused(fine.leaving(rest) if rest else fine)
    del fine  # its rows are large
    first = looked_over(halved_throughout(first))
    record = first.declared, chunk, first.weights, first.revision
    return with_spreads(one_pass(*record, first, bank=False))


def on_its_grid(
    model: Machine,
    chunk: FloatArray,
    parts: tuple[AddedEffect, ...] = (),
    suspects: tuple[Effect, ...] = (),
) -> Fit:
    """As `fitted`, on the grid that is declared; chunk (n, 2 + signals), SI."""
    model, chunk = as_measured(model, chunk), usable(model, chunk)
    weights = prepare(model, chunk)
    revision = recall(model, chunk, weights, parts, suspects)
    return fit(model, chunk, weights, revision, bank=False)


def stand(
    model: Machine,
    chunk: FloatArray,
    held_out: FloatArray,
    parts: tuple[AddedEffect, ...] = (),
    progress: Progress = silent,
    known: Fit | None = None,
    suspects: tuple[Effect, ...] = (),
) -> Standing:
    """The model with its parts on a record; chunk and held_out (n, 2 + signals), SI.

    known: what `fitted` has made of them before; suspects: effects of the user's that are scored
    beside those of the catalogue.
    """
    progress("fitting", 0.0)
    first = known or fitted(model, chunk, parts, suspects)
    judging = usable(first.declared, held_out)
    state = TrialState(
        first.declared, first.chunk, judging, progress, given=parts, suspects=suspects
    )
    return Standing(state, with_bank(first, suspects))


def with_bank(present: Fit, suspects: tuple[Effect, ...] = ()) -> Fit:
    """A fit where it is, with every candidate beside it."""
    record = present.declared, present.chunk, present.weights, present.revision
    banked = one_pass(*record, present.unread(), bank=True, suspects=suspects)
    return with_spreads(banked) if present.spreads else banked
