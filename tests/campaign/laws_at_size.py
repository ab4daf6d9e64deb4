"""The campaign of ten valve laws, case by case: each is kept, so that it can stop and go on.

python -m tests.campaign.laws_at_size rich|sweep|clean|limit FIRST LAST    (machines per law)
python -m tests.campaign.laws_at_size rich|sweep SEED LAW [EFFECT]        (one machine, in words)

limit: effects at twice the size from which on the records of the clean machines, of those that are
kept, say that they are named.

What is kept in out/campaign/laws makes the lines of the table, however few they are.
"""

from __future__ import annotations

import pickle
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rtid.plain import FloatArray
from rtid.sim.hideable import KNOWN
from rtid.sim.valve_laws import LAWS
from tests.campaign.diagnoses import IN_SET, RIGHT, WRONG, wilson
from tests.campaign.laws import Answer, Case, Outcome, answer, answer_of, judged, outcome
from tests.campaign.report import FOLDER, leave

FIRST, HIDING, CLEAN, LIMIT = 5000, 1000, "clean", "limit"
AT_LIMIT = (
    ("external_leakage_laminar", "a"),
    ("internal_leakage_laminar", "a-b"),
    ("input_delay", "command"),
)
MOTIONS = {"rich": "rich_record", "sweep": "sweep_record"}
# what a free map takes in whatever the motion is no effect that could be named
SWALLOWED = ("deadband_shift", "pressure_sensor_bias", "load_compensated_valve", "velocity_scale")
EFFECTS = tuple(name for name in KNOWN if name not in SWALLOWED)
ALARMS = ("missing", "ambiguous", "unknown")
Z95 = 1.96
MOST_LEFT = 1.15  # times what the same machine leaves without the effect
PAGE = "docs/figures.md"


def cases(kind: str, first: int, last: int) -> Iterator[Case]:
    """The machines first to last of each law; of four clean ones, one makes the paper's sweep."""
    if kind == LIMIT:
        yield from _at_limits(range(FIRST + first, FIRST + last))
        return
    for k in range(first, last):
        for j, law in enumerate(LAWS):
            if kind == CLEAN:
                motion = MOTIONS["sweep" if k % 4 == 3 else "rich"]
                yield Case(FIRST + k, law, motion)
            else:
                hidden = EFFECTS[(k * len(LAWS) + j) % len(EFFECTS)]
                yield Case(FIRST + HIDING + k, law, MOTIONS[kind], hidden)


def _at_limits(seeds: range) -> Iterator[Case]:
    """Twice what the records of clean machines state, on rich motion."""
    for o in kept(CLEAN):
        for name, where in AT_LIMIT if o.case.seed in seeds else ():
            limit = o.limits.get((name, where), np.inf)
            if np.isfinite(limit) and o.case.motion == MOTIONS["rich"]:
                yield Case(o.case.seed, o.case.law, o.case.motion, name, 2.0 * limit)


def kept(kind: str) -> list[Any]:
    """What stands of a kind."""
    paths = sorted((FOLDER / "laws").glob(f"{kind}_*.pkl"))
    found = [pickle.loads(path.read_bytes()) for path in paths]
    return [x for x in found if x is not None]


def judge_all(kind: str, first: int, last: int) -> None:
    """Judge those that are not kept yet."""
    folder = FOLDER / "laws"
    folder.mkdir(parents=True, exist_ok=True)
    for case in cases(kind, first, last):
        name = f"{kind}_{case.seed}_{case.law}" + (f"_{case.hidden}" if kind == LIMIT else "")
        path = folder / f"{name}.pkl"
        if not path.exists():
            path.write_bytes(pickle.dumps((outcome if kind == CLEAN else answer)(case)))


def covered(z: FloatArray) -> str:
    """The share of errors (n,), in standard deviations, within 95 %, with Wilson's interval."""
    inside = int((np.abs(z) < Z95).sum())
    return _share(inside, len(z))


def _share(hits: int, n: int) -> str:
    low, high = wilson(hits, n)
    return f"{hits} of {n} ({100 * low:.0f} to {100 * high:.0f} %)"


def of_hidden(found: list[Answer]) -> str:
    """The words of machines with an effect."""
    said = Counter(o.judgement for o in found)
    hidden = sum(o.is_hidden for o in found if o.judgement in (RIGHT, IN_SET))
    named = sum(said[j] for j in (RIGHT, IN_SET))
    z, half = (
        np.array([getattr(o, n) for o in found if np.isfinite(o.size_z)])
        for n in ("size_z", "size_half")
    )
    beta = np.concatenate([o.beta_z for o in found if o.judgement in (RIGHT, IN_SET)])
    wide = np.concatenate([o.beta_half for o in found if o.judgement in (RIGHT, IN_SET)])
    paired = [o for o in found if np.isfinite(o.clean_left)]
    wrong = ", ".join(f"{o.case.hidden} as {o.named}" for o in found if o.judgement == WRONG)
    missed = [o for o in found if o.judgement not in (RIGHT, IN_SET, WRONG)]
    near = sum(o.left <= MOST_LEFT * o.clean_left for o in paired)
    parts = [
        ", ".join(f"{judgement} {n}" for judgement, n in said.most_common()),
        f"named {_share(named, len(found))}, {hidden} of them as hidden in the maps",
        f"sizes {covered(z)}, half-width {100 * np.median(half):.1f} %",
        f"moduli beside what is named {covered(beta)}, half-width {100 * np.median(wide):.2f} %",
        f"left at most 1.15 x the same machine's without it {_share(near, len(paired))}",
        f"median {np.median([o.seconds for o in found]):.1f} s of processor time",
        f"wrong: {wrong or 'none'}",
        f"not named: {of_missed(missed)}",
    ]
    return "; ".join(parts)


def of_missed(missed: list[Answer]) -> str:
    """Each that is not named, and how large it is beside the limit that its record itself states.

    Below it nothing else was promised: "named from" is what a reader is told.
    """
    if not missed:
        return "none"
    limits = [getattr(o, "of_limit", np.nan) for o in missed]  # kept ones may be older
    below = sum(size < 1.0 for size in limits)
    words = [
        "" if np.isnan(size) else f" ({size:.2g} of it)" if size else " (no possible size is named)"
        for size in limits
    ]
    each = ", ".join(o.case.hidden + text for o, text in zip(missed, words, strict=True))
    return f"{len(missed)}, {below} of them below the limit that the record states: {each}"


def of_clean(found: list[Outcome]) -> str:
    """The words of all clean machines."""
    alarms = [f"{o.case.seed} {o.case.law}" for o in found if o.verdict in ALARMS]
    said = Counter(o.verdict for o in found).most_common()
    rho = {law: [o.rho for o in found if o.case.law == law] for law in LAWS}
    worst = max((x for x in rho if rho[x]), key=lambda law: abs(np.median(rho[law]) - 1.0))
    beta, half, valid, near, wide = (
        np.concatenate(part)
        for part in (
            [o.beta_z for o in found],
            [o.beta_half for o in found],
            [o.valid.z for o in found],
            [o.near.z for o in found],
            [o.near.half for o in found],
        )
    )
    in_band = sum(abs(o.rho - 1.0) < o.band for o in found)
    parts = [
        f"alarms {_share(len(alarms), len(found))} {', '.join(alarms)}".rstrip(),
        ", ".join(f"{verdict} {n}" for verdict, n in said),
        f"rho median {np.median([o.rho for o in found]):.3f}, farthest off 1 {worst} "
        f"{np.median(rho[worst]):.3f}, within 3 sqrt(2/dof) {_share(in_band, len(found))}",
        f"moduli {covered(beta)}, half-width {100 * np.median(half):.2f} %",
        f"valid points {100 * np.mean(np.abs(valid) < Z95):.1f} %",
        f"extrapolated {100 * np.mean(np.abs(near) < Z95):.1f} %, "
        f"half-width {100 * np.median(wide):.1f} %",
    ]
    return "; ".join(parts)


def say(case: Case) -> None:
    """Judge one machine, and print what is said of it beside the truth."""
    found = judged(case)
    if found is None:
        print("it leaves its stroke or cavitates: not simulated")
        return
    said, true = found.said, ", ".join(f"{h.name} {h.strength:.4g}" for h in case.plant.hidden)
    judgement = answer_of(case, found).judgement if case.hidden else said.verdict
    print(
        f"{judgement}; rho {found.present.rho:.3f} -> {found.last.rho:.3f}; true: {true or 'none'}"
    )
    for effect in said.found:
        sizes = ", ".join(f"{k} {v.value:.4g} +- {v.std:.2g}" for k, v in effect.parameters.items())
        print(f"{effect.effect} at {effect.where}: {sizes}; or {effect.cannot_be_told_from}")


def main(kind: str, first: str, last: str) -> None:
    """Judge, and leave the lines of all that is kept."""
    judge_all(kind, int(first), int(last))
    clean = kept(CLEAN)
    for motion, record in MOTIONS.items():
        if found := [o for o in clean if o.case.motion == record]:
            seeds = ", ".join(map(str, sorted({o.case.seed for o in found})))
            leave(
                f"clean valves of ten laws, {motion}, seeds {seeds}", of_clean(found),
                "at most 1 % of 420; rho 1.00 +- 0.02; 93 to 97 %", f"{len(found)} machines, 44 s",
            )  # fmt: skip
    if weak := kept(LIMIT):
        named = sum(o.judgement in (RIGHT, IN_SET) for o in weak)
        said = Counter(f"{o.case.hidden} {o.judgement}" for o in weak)
        each = ", ".join(f"{words} {n}" for words, n in said.items())
        wrong = [
            f"{o.case.hidden} as {o.named}, {o.case.law}" for o in weak if o.judgement == WRONG
        ]
        leave(
            "effects at twice the size that is said to be named, ten laws, at a reduced size",
            f"{_share(named, len(weak))}; {each}; wrong: {', '.join(wrong) or 'none'}",
            "90 %", f"{len(weak)} machines, rich motion, 44 s",
        )  # fmt: skip
    for motion in MOTIONS:
        everyone = kept(motion)
        for seed in sorted({o.case.seed for o in everyone}):
            found = [o for o in everyone if o.case.seed == seed]
            leave(
                f"effects in valves of ten laws, {motion}, seed {seed}",
                of_hidden(found), "named 95 %, no wrong name; 93 to 97 %",
                f"{len(found)} machines, middle, 44 s",
            )  # fmt: skip


if __name__ == "__main__":
    Path(FOLDER).mkdir(parents=True, exist_ok=True)
    if sys.argv[3] in LAWS:
        hidden = "".join(sys.argv[4:5])
        say(Case(int(sys.argv[2]), sys.argv[3], MOTIONS[sys.argv[1]], hidden))
    else:
        main(*sys.argv[1:4])
