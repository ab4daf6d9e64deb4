"""A map that the daemon offers for `rtid apply`: it has beaten the one held on unseen samples."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtid.apply.judge import KnownMap
from rtid.errors import RtidError
from rtid.maps.files import read_map, write_map
from rtid.plain import FloatArray
from rtid.units import with_unit

FILE = "offer.npz"
PART = "part-offer.npz"  # the suffix names the format


class NoOfferError(RtidError):
    """There is nothing to apply; the text says why."""


@dataclass(frozen=True, eq=False)
class Offer:
    """A map with its bulk modulus; judgement: JSON of `judging.Judgement`.

    against: the content (see `rtid.apply.versions`) that it has beaten, None: nothing was held.
    """

    known: KnownMap
    sd_pa: FloatArray
    against: int | None
    judgement: dict[str, Any]
    provenance: dict[str, Any]
    unix_s: float

    def sentence(self) -> str:
        """Why it is offered."""
        j = self.judgement
        other = "without any map" if self.against is None else "with the map held"
        return (
            f"on {j['blocks']} s of motion that it has not learned from, the residual is "
            f"{with_unit(j['new_m3s'], 'm3/s')}, {other} {with_unit(j['held_m3s'], 'm3/s')} "
            f"({j['gain_percent']:.1f} % less, t = {j['t']:.1f})"
        )


def write(folder: Path, offer: Offer) -> None:
    """Replace the offer in the state folder, whole or not at all."""
    provenance = {
        "beta_pa": offer.known.beta_pa.tolist(),
        "sd_pa": offer.sd_pa.tolist(),
        "against": offer.against,
        "judgement": offer.judgement,
        "provenance": offer.provenance,
        "unix_s": offer.unix_s,
    }
    write_map(folder / PART, offer.known.flow_map, provenance)
    os.replace(folder / PART, folder / FILE)


def read(folder: Path) -> Offer:
    """The offer of the daemon that keeps its state here.  Raises NoOfferError, MapFileError."""
    try:
        flow_map, provenance = read_map(folder / FILE)
    except FileNotFoundError:
        raise NoOfferError(
            f"{folder}: no map is offered: none has yet beaten the one held on new samples",
            "let the machine move while `rtid run` runs (publish.judge_s), or --map with --against",
            4,
        ) from None
    return Offer(
        KnownMap(flow_map, np.asarray(provenance["beta_pa"], float)),
        np.asarray(provenance["sd_pa"], float),
        provenance["against"],
        provenance["judgement"],
        provenance["provenance"],
        provenance["unix_s"],
    )


def withdraw(folder: Path) -> None:
    """It was applied, or no longer holds."""
    (folder / FILE).unlink(missing_ok=True)


def exists(folder: Path) -> bool:
    """Whether a map is offered."""
    return (folder / FILE).is_file()


def as_text(path: Path) -> str:
    """One line for `rtid status`; "" without an offer."""
    try:
        return read(path).sentence() if exists(path) else ""
    except (RtidError, OSError, KeyError, json.JSONDecodeError):
        return ""
