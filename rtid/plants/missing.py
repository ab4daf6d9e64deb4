"""Which effect is missing in a plant, by the error of its free run.

Forward: every effect at every place is fitted roughly beside the model so far, the best few to the
end, and the best one is added.  One that hides behind a larger one looks insignificant, because a
residual that remembers is worth few samples; so the search goes on until two in a row are
insignificant, and takes both back where they are so together too.  Backward: what the final model
can do without goes, and each effect that stays is held against every other in its place.  Only the
identification part is looked at.  At the end a record that nobody has fitted may refute effects:
one with which the error there does not fall is not named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rtid.plain import FloatArray, Key, Progress, silent
from rtid.plants.fitted import PlantModel, continued, exchanged, polished, refit, roughly, without
from rtid.plants.insertion import everywhere
from rtid.plants.output_error import PlantFit
from rtid.plants.plant import Plant, PlantRecord
from rtid.plants.statistics import f_test
from rtid.plants.validation import left_out, rms, sensor_noise

ALPHA = 0.01  # chance of a false alarm over all candidates of a round
PROMISING = 3  # of the effects beside a model, those that are fitted to the end
PATIENCE = 2  # insignificant additions in a row that end the search
MOST = 6  # effects that are added at most
MATERIAL = 0.003  # of the output's spread: what an effect must take off the held-out error
TOLD_APART = 12.0  # of twice the log likelihood: by so much a rival must be worse
HOPELESS = 4.0 * TOLD_APART  # a rival that is so much worse after a few runs is not fitted on
BETTER = 2.0  # of the information criterion: what an exchange must gain
CLEAN = 1.2  # mean square of the residual in units of the sensors' noise
EXPLAINED = 0.8  # of the misfit: less, with something left behind, is no explanation
FEWEST = 10  # samples per unknown

MATCHES, MISSING, AMBIGUOUS = "matches", "missing", "ambiguous"
UNKNOWN, INSUFFICIENT = "unknown", "insufficient_data"


@dataclass(frozen=True)
class MissingEffect:
    """An effect that is missing: without it the final model is worse by so much.

    without: the model without it.
    """

    key: Key
    alike: tuple[Key, ...]
    p_value: float
    held_out_before: FloatArray
    held_out_after: FloatArray
    without: PlantModel

    @property
    def gain_percent(self) -> float:
        """Fall of the held-out error, in per cent of what it is without the effect."""
        return float(100.0 * (1.0 - np.mean(self.held_out_after / self.held_out_before)))


@dataclass(frozen=True)
class Refuted:
    """An effect that a fit wants, and the errors (outputs,) without and with it on unseen data."""

    key: Key
    unseen_before: FloatArray
    unseen_after: FloatArray


@dataclass(frozen=True)
class PlantDiagnosis:
    """The plant as it was given and with what was found; what was not found, beside it.

    refuted: what helps where it was fitted, and not on unseen data;
    path: the effects in the order in which the search added them, with the error then (outputs,).
    """

    first: PlantModel
    last: PlantModel
    found: tuple[MissingEffect, ...]
    negligible: tuple[MissingEffect, ...]
    rivals: tuple[PlantModel, ...]
    path: tuple[tuple[Key, FloatArray], ...]
    noise: FloatArray
    verdict: str
    refuted: tuple[Refuted, ...] = ()


@dataclass
class _Search:
    progress: Progress
    path: list[tuple[Key, FloatArray]] = field(default_factory=list)
    negligible: list[MissingEffect] = field(default_factory=list)
    held_out: dict[frozenset[Key], FloatArray] = field(default_factory=dict)
    fits: list[PlantFit] = field(default_factory=list)
    seen: set[frozenset[Key]] = field(default_factory=set)

    def is_new(self, model: PlantModel) -> bool:
        """False from the second time on: an exchange must not go in circles."""
        keys = frozenset(model.keys)
        seen = keys in self.seen
        self.seen.add(keys)
        return not seen

    def error(self, model: PlantModel) -> FloatArray:
        """Held-out error (outputs,), each model's once."""
        key = frozenset(model.keys)
        if key not in self.held_out:
            self.held_out[key] = rms(left_out(model.fit))
        return self.held_out[key]


def diagnose(
    plant: Plant,
    record: PlantRecord,
    progress: Progress = silent,
    add: tuple[Key, ...] = (),
    unseen: Callable[[PlantModel], FloatArray] | None = None,
    *,
    with_limits: bool = True,
) -> PlantDiagnosis:
    """Find the effects that are missing in a plant, beside those that are added already.

    unseen: a model's error (outputs,), in their units, on data that are kept from the fit, if there
    are any.  with_limits: what was not found is looked at as well.
    Raises PlantError if the plant cannot be fitted.
    """
    search = _Search(progress)
    progress("fitting", 0.0)
    fitted = refit(plant, record, add).fit
    first = PlantModel(fitted.plant, fitted)
    last, missings = _pruned(search, _grown(search, first))
    refuted: tuple[Refuted, ...] = ()
    if unseen is not None:
        progress("checking on unseen data", 0.85)
        last, missings, refuted = _confirmed(search, last, missings, unseen)
    progress("looking at what was not found", 0.9)
    rivals = tuple(map(continued, _candidates(search, last, 0.9, 1.0) if with_limits else ()))
    noise = sensor_noise(plant, record)
    verdict = _verdict(first, last, missings, noise)
    path, negligible = tuple(search.path), tuple(search.negligible)
    return PlantDiagnosis(first, last, missings, negligible, rivals, path, noise, verdict, refuted)


def rho(model: PlantModel, noise: FloatArray) -> float:
    """Mean square of a model's residual in units of the sensors' noise (outputs,)."""
    least = 1e-6 * np.nanstd(model.fit.simulator.record.y, axis=0)
    return float(np.mean((model.fit.rmse / np.maximum(noise, least)) ** 2))


def _grown(search: _Search, model: PlantModel) -> PlantModel:
    """Add the best effect again and again."""
    sure = model
    search.fits.append(model.fit)
    for k in range(MOST):
        candidates = _candidates(search, model, 0.05 + 0.5 * k / MOST, 0.05 + 0.5 * (k + 1) / MOST)
        if not candidates:
            break
        rough = sorted(candidates, key=lambda c: c.fit.sse)
        best = polished(min((continued(c) for c in rough[:PROMISING]), key=lambda c: c.fit.sse))
        least = ALPHA / len(candidates)
        if chance(model, best) < least:
            sure = best
        model = best
        search.fits.append(model.fit)
        search.path.append((model.keys[-1], model.fit.rmse))
        if len(model.keys) - len(sure.keys) == PATIENCE:
            return sure if chance(sure, model) >= least else model
    return model


def _candidates(search: _Search, model: PlantModel, begin: float, end: float) -> list[PlantModel]:
    """The model with every possible effect more, roughly, one at a time; begin, end: of it all."""
    keys, models = everywhere(model.fit.plant), []
    for k, key in enumerate(keys):
        search.progress(f"trying {key[0]} at {key[1]}", begin + (end - begin) * k / len(keys))
        models.append(roughly(model, key))
    return [m for m in models if m is not None]


def chance(less: PlantModel, more: PlantModel) -> float:
    """Chance that the effects that `more` has beyond `less` explain so much by accident."""
    n = len(more.fit.values)
    return f_test(less.fit.sse, more.fit.sse, n - len(less.fit.values), more.fit.worth, n)


def _pruned(search: _Search, model: PlantModel) -> tuple[PlantModel, tuple[MissingEffect, ...]]:
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
        rivals = {key: _rivals(search, less[key], model, key) for key in model.keys}
        others = [m for some in rivals.values() for m in some]
        best = min(others, key=lambda m: _score(m, model), default=model)
        if _score(best, model) < _score(model, model) - BETTER and search.is_new(best):
            model = polished(best)
            continue
        return model, tuple(
            _found(search, less[key], model, key, _alike(model, rivals[key])) for key in model.keys
        )
    return model, ()


def _confirmed(
    search: _Search,
    model: PlantModel,
    missings: tuple[MissingEffect, ...],
    unseen: Callable[[PlantModel], FloatArray],
) -> tuple[PlantModel, tuple[MissingEffect, ...], tuple[Refuted, ...]]:
    """Take out what does not help on unseen data, the worst first."""
    refuted: list[Refuted] = []
    while missings:
        after = unseen(model)
        before = [unseen(f.without) for f in missings]
        growth = [float(np.mean(after / b)) for b in before]
        worst = int(np.argmax(growth))
        if growth[worst] < 1.0:
            break
        gone = missings[worst]
        refuted.append(Refuted(gone.key, before[worst], after))
        model = polished(gone.without)
        less = {f.key: without(model, f.key, search.fits) for f in missings if f is not gone}
        missings = tuple(
            _found(search, less[f.key], model, f.key, f.alike) for f in missings if f is not gone
        )
    return model, missings, tuple(refuted)


def _score(model: PlantModel, beside: PlantModel) -> float:
    """Information criterion (Schwarz) with the samples that `beside` is worth."""
    worth = beside.fit.worth
    return float(worth * np.log(model.fit.sse) + len(model.fit.values) * np.log(worth))


def _material(search: _Search, less: PlantModel, model: PlantModel) -> float:
    """What an effect takes off the held-out error, of the output's spread."""
    gone = search.error(less) ** 2 - search.error(model) ** 2
    spread = np.nanstd(model.fit.simulator.record.y, axis=0)
    return float(np.sqrt(np.maximum(gone, 0.0)).max() / spread.max())


def _rivals(search: _Search, less: PlantModel, model: PlantModel, key: Key) -> list[PlantModel]:
    """Models with every other effect in the place of one."""
    models = []
    for other in everywhere(less.fit.plant):
        if other != key and other not in model.keys:
            search.progress(f"trying {other[0]} for {key[0]}", 0.7)
            rival = exchanged(model, less, other)
            models += [rival] if rival is not None else []
    models.sort(key=lambda m: m.fit.sse)
    close = max(PROMISING, sum(_gap(m, model) < HOPELESS for m in models))
    return [*map(continued, models[:close]), *models[close:]]


def _gap(rival: PlantModel, model: PlantModel) -> float:
    """By how much of twice the log likelihood a rival is worse."""
    return float(model.fit.worth * np.log(rival.fit.sse / model.fit.sse))


def _alike(model: PlantModel, rivals: list[PlantModel]) -> tuple[Key, ...]:
    """Effects that do as well as far as the record can tell."""
    close = [m for m in rivals if _gap(m, model) < TOLD_APART]
    return tuple(m.keys[-1] for m in sorted(close, key=lambda m: m.fit.sse))


def _found(
    search: _Search, less: PlantModel, model: PlantModel, key: Key, alike: tuple[Key, ...]
) -> MissingEffect:
    return MissingEffect(
        key, alike, chance(less, model), search.error(less), search.error(model), less
    )


def _verdict(
    first: PlantModel, last: PlantModel, missings: tuple[MissingEffect, ...], noise: FloatArray
) -> str:
    if first.fit.samples < FEWEST * len(first.fit.values):
        return INSUFFICIENT
    before, after = rho(first, noise), rho(last, noise)
    if not missings:
        return MATCHES if after < CLEAN else UNKNOWN
    if after > CLEAN and (before - after) < EXPLAINED * (before - 1.0):
        return UNKNOWN
    return AMBIGUOUS if missings[0].alike else MISSING
