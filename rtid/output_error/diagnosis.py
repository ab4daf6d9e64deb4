"""Which effect is missing in a plant, by the error of its free run.

Forward: every effect at every place is fitted beside the model so far, the best one is added.  One
that hides behind a larger one looks insignificant, because a residual that remembers is worth few
samples; so the search goes on until two in a row are insignificant.  Backward: what the final model
can do without goes, and each effect that stays is held against every other in its place.  Only the
identification part is looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rtid.effects.tree import FloatArray
from rtid.output_error.fit import Fit
from rtid.output_error.insertion import everywhere
from rtid.output_error.model import Key, Model, exchanged, polished, refit, with_effect, without
from rtid.output_error.plant import Plant, Record
from rtid.output_error.statistics import f_test
from rtid.output_error.validation import left_out, rms, sensor_noise

ALPHA = 0.01  # chance of a false alarm over all candidates of a round
PATIENCE = 2  # insignificant additions in a row that end the search
MOST = 6  # effects that are added at most
MATERIAL = 0.003  # of the output's spread: what an effect must take off the held-out error
TOLD_APART = 12.0  # of twice the log likelihood: by so much a rival must be worse
BETTER = 2.0  # of the information criterion: what an exchange must gain
CLEAN = 1.2  # mean square of the residual in units of the sensors' noise
EXPLAINED = 0.8  # of the misfit: less, with something left behind, is no explanation
FEWEST = 10  # samples per unknown

MATCHES, MISSING, AMBIGUOUS = "matches", "missing", "ambiguous"
UNKNOWN, INSUFFICIENT = "unknown", "insufficient_data"


@dataclass(frozen=True)
class Found:
    """An effect that is missing: without it the final model is worse by so much."""

    key: Key
    alike: tuple[Key, ...]
    p_value: float
    held_out_before: FloatArray
    held_out_after: FloatArray

    @property
    def gain_percent(self) -> float:
        """Fall of the held-out error, in per cent of what it is without the effect."""
        return float(100.0 * (1.0 - np.mean(self.held_out_after / self.held_out_before)))


@dataclass(frozen=True)
class Diagnosis:
    """The plant as it was given and with what was found; what was not found, beside it.

    path: the effects in the order in which the search added them, with the error then (outputs,).
    """

    first: Model
    last: Model
    found: tuple[Found, ...]
    negligible: tuple[Found, ...]
    rivals: tuple[Model, ...]
    path: tuple[tuple[Key, FloatArray], ...]
    noise: FloatArray
    verdict: str


@dataclass
class _Search:
    progress: Callable[[str, float], None]
    path: list[tuple[Key, FloatArray]] = field(default_factory=list)
    negligible: list[Found] = field(default_factory=list)
    held_out: dict[frozenset[Key], FloatArray] = field(default_factory=dict)
    fits: list[Fit] = field(default_factory=list)
    seen: set[frozenset[Key]] = field(default_factory=set)

    def is_new(self, model: Model) -> bool:
        """False from the second time on: an exchange must not go in circles."""
        keys = frozenset(model.keys)
        seen = keys in self.seen
        self.seen.add(keys)
        return not seen

    def error(self, model: Model) -> FloatArray:
        """Held-out error (outputs,), each model's once."""
        key = frozenset(model.keys)
        if key not in self.held_out:
            self.held_out[key] = rms(left_out(model.fit))
        return self.held_out[key]


def _silent(_what: str, _share: float) -> None:
    pass


def diagnose(
    plant: Plant,
    record: Record,
    progress: Callable[[str, float], None] = _silent,
    add: tuple[Key, ...] = (),
) -> Diagnosis:
    """Find the effects that are missing in a plant, beside those that are added already.

    Raises PlantError if the plant cannot be fitted.
    """
    search = _Search(progress)
    progress("fitting", 0.0)
    fitted = refit(plant, record, add).fit
    first = Model(fitted.plant, fitted)
    last, found = _pruned(search, _grown(search, first))
    progress("looking at what was not found", 0.9)
    rivals = tuple(_candidates(last))
    noise = sensor_noise(plant, record)
    verdict = _verdict(first, last, found, noise)
    path, negligible = tuple(search.path), tuple(search.negligible)
    return Diagnosis(first, last, found, negligible, rivals, path, noise, verdict)


def rho(model: Model, noise: FloatArray) -> float:
    """Mean square of a model's residual in units of the sensors' noise."""
    least = 1e-6 * np.nanstd(model.fit.simulator.record.y, axis=0)
    return float(np.mean((model.fit.rmse / np.maximum(noise, least)) ** 2))


def _grown(search: _Search, model: Model) -> Model:
    """Add the best effect again and again."""
    insignificant = 0
    search.fits.append(model.fit)
    for k in range(MOST):
        search.progress("adding effects", 0.05 + 0.5 * k / MOST)
        candidates = _candidates(model)
        if not candidates:
            break
        best = polished(min(candidates, key=lambda c: c.fit.sse))
        significant = chance(model, best) < ALPHA / len(candidates)
        insignificant = 0 if significant else insignificant + 1
        model = best
        search.fits.append(model.fit)
        search.path.append((model.keys[-1], model.fit.rmse))
        if insignificant == PATIENCE:
            break
    return model


def _candidates(model: Model) -> list[Model]:
    """The model with every possible effect more, one at a time."""
    found = (with_effect(model, key) for key in everywhere(model.fit.plant))
    return [m for m in found if m is not None]


def chance(less: Model, more: Model) -> float:
    """Chance that the effects that `more` has beyond `less` explain so much by accident."""
    n = len(more.fit.values)
    return f_test(less.fit.sse, more.fit.sse, n - len(less.fit.values), more.fit.worth, n)


def _pruned(search: _Search, model: Model) -> tuple[Model, tuple[Found, ...]]:
    """Drop what is insignificant or immaterial, the least first; exchange what does better."""
    while model.keys:
        search.progress("looking back", 0.6)
        less = {key: without(model, key, search.fits) for key in model.keys}
        chances = {key: chance(less[key], model) for key in model.keys}
        worst = max(chances, key=lambda key: chances[key])
        if chances[worst] > ALPHA / len(everywhere(model.base)):
            model = polished(less[worst])
            continue
        shares = {key: _material(search, less[key], model) for key in model.keys}
        slight = [key for key in model.keys if shares[key] < MATERIAL]
        if slight:
            least = min(slight, key=lambda key: _score(less[key], model))
            search.negligible.append(_found(search, less[least], model, least, ()))
            model = polished(less[least])
            continue
        search.progress("exchanging effects", 0.7)
        rivals = {key: _rivals(less[key], model, key) for key in model.keys}
        others = [m for some in rivals.values() for m in some]
        best = min(others, key=lambda m: _score(m, model), default=model)
        if _score(best, model) < _score(model, model) - BETTER and search.is_new(best):
            model = polished(best)
            continue
        return model, tuple(
            _found(search, less[key], model, key, _alike(model, rivals[key])) for key in model.keys
        )
    return model, ()


def _score(model: Model, beside: Model) -> float:
    """Information criterion (Schwarz) with the samples that `beside` is worth."""
    worth = beside.fit.worth
    return float(worth * np.log(model.fit.sse) + len(model.fit.values) * np.log(worth))


def _material(search: _Search, less: Model, model: Model) -> float:
    """What an effect takes off the held-out error, of the output's spread."""
    gone = search.error(less) ** 2 - search.error(model) ** 2
    spread = np.nanstd(model.fit.simulator.record.y, axis=0)
    return float(np.sqrt(np.maximum(gone, 0.0)).max() / spread.max())


def _rivals(less: Model, model: Model, key: Key) -> list[Model]:
    """Models with every other effect in the place of one."""
    found = []
    for other in everywhere(less.fit.plant):
        if other != key and other not in model.keys:
            rival = exchanged(model, less, other)
            found += [rival] if rival is not None else []
    return found


def _alike(model: Model, rivals: list[Model]) -> tuple[Key, ...]:
    """Effects that do as well as far as the record can tell."""
    worse = model.fit.worth * np.log([m.fit.sse / model.fit.sse for m in rivals])
    close = [m for m, gap in zip(rivals, worse, strict=True) if gap < TOLD_APART]
    return tuple(m.keys[-1] for m in sorted(close, key=lambda m: m.fit.sse))


def _found(search: _Search, less: Model, model: Model, key: Key, alike: tuple[Key, ...]) -> Found:
    return Found(key, alike, chance(less, model), search.error(less), search.error(model))


def _verdict(first: Model, last: Model, found: tuple[Found, ...], noise: FloatArray) -> str:
    if first.fit.samples < FEWEST * len(first.fit.values):
        return INSUFFICIENT
    before, after = rho(first, noise), rho(last, noise)
    if not found:
        return MATCHES if after < CLEAN else UNKNOWN
    if after > CLEAN and (before - after) < EXPLAINED * (before - 1.0):
        return UNKNOWN
    return AMBIGUOUS if found[0].alike else MISSING
