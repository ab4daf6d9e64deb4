"""From fits to what the project file says of them: parameters, errors before and after."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from rtid.diagnose.extend import Extension
from rtid.diagnose.fitted_sizes import parameters
from rtid.diagnose.report import Value
from rtid.diagnose.residual import Residual
from rtid.diagnose.standing import Standing
from rtid.effects.page import is_zero
from rtid.project.added import AddedSection, ChangeSection, ErrorsSection, ParameterSection


def now() -> datetime:
    """The date of a change, to the second."""
    return datetime.now(UTC).replace(microsecond=0)


def extended(
    sections: tuple[AddedSection, ...], extension: Extension, trace: str, reason: str
) -> tuple[AddedSection, ...]:
    """The sections with the new one; parameters of all as fitted with it."""
    (effect, where), after = extension.key, extension.after
    own_spools = [t.own_spools for t, _ in after.fit.revision.timings if t.effect == effect]
    new = AddedSection(
        effect=effect,
        where=where,
        own_spools=any(own_spools),
        date=now(),
        trace=trace,
        reason=reason,
        parameters={name: _parameter(value) for name, value in extension.sizes.items()}
        or _parameters(after, extension.key),
        errors=errors_between(extension.before, after),
    )
    return (*refreshed(sections, after), new)


def refreshed(sections: Sequence[AddedSection], present: Standing) -> tuple[AddedSection, ...]:
    """The sections with their parameters as fitted now; a zero stays as it was found."""
    return tuple(
        s if is_zero(s.effect) else s.model_copy(update={"parameters": _parameters(present, s.key)})
        for s in sections
    )


def _parameters(present: Standing, key: tuple[str, str]) -> dict[str, ParameterSection]:
    return {name: _parameter(value) for name, value in parameters(present.fit, key).items()}


def _parameter(value: Value) -> ParameterSection:
    return ParameterSection(value=float(value.value), sd=_finite(value.std), unit=value.unit)


def errors_between(before: Standing, after: Standing) -> ErrorsSection:
    """The errors of both parts without and with a change.

    In per cent all are shares of the flow that the fuller model is judged on, as in a diagnosis:
    the map that is bent by what is missing is known in other places.
    """
    fuller = max(before, after, key=lambda s: s.fit.revision.n_causes)
    learned, held_out = fuller.identification.flow_m3s, fuller.held_out.flow_m3s
    return ErrorsSection(
        rho=_pair(before.fit.rho, after.fit.rho),
        identification_m3s=_pair(before.identification.rms_m3s, after.identification.rms_m3s),
        identification_pct=_percents(before.identification, after.identification, learned),
        heldout_m3s=_pair(before.held_out.rms_m3s, after.held_out.rms_m3s),
        heldout_pct=_percents(before.held_out, after.held_out, held_out),
        noise_floor_m3s=_finite(after.held_out.floor_m3s),
        noise_floor_pct=_finite(100 * after.held_out.floor_m3s / held_out),
        judged_s=after.held_out.judged_s,
    )


def _percents(before: Residual, after: Residual, flow_m3s: float) -> ChangeSection:
    return _pair(*(100 * residual.rms_m3s / flow_m3s for residual in (before, after)))


def _pair(before: float, after: float) -> ChangeSection:
    return ChangeSection(before=_finite(before), after=_finite(after))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def turned(errors: ErrorsSection) -> ErrorsSection:
    """The errors of the change the other way round."""
    turned = {
        name: ChangeSection(before=value.after, after=value.before)
        for name, value in errors
        if isinstance(value, ChangeSection)
    }
    return errors.model_copy(update=turned)


def plain(errors: ErrorsSection) -> dict[str, Any]:
    """As JSON takes it, without what is not known."""
    return errors.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
