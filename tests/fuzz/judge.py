"""What is wrong with the outcome of a case: a traceback, an odd output, a silent loss."""

from __future__ import annotations

import json
import re
from typing import Any

from firmware_bridge.catalog import CatalogError
from firmware_bridge.catalog import load as load_catalog
from tests.fuzz.cases import Case
from tests.fuzz.command import Outcome
from tests.fuzz.seeds import Seeds

CODES = (0, 2, 3, 4)
WARNING = re.compile(r"(?m)^.*\w+Warning: .*$")
FRAME = re.compile(rb"(?i)(\b|x)0*12[012]x?\b")  # the identifiers of the sound logs
NOT_LOST = ("gap", "clock_step", "truncated")  # counted beside the rows that are kept


def judge(case: Case, outcome: Outcome, seeds: Seeds) -> tuple[str, str]:
    """Name of the defect and its detail; "" where there is none."""
    if outcome.raised:
        return "traceback", outcome.raised
    if "Traceback (most recent call last)" in outcome.err:
        return "traceback", outcome.err
    if outcome.code not in CODES:
        return "output", f"exit code {outcome.code}\n{outcome.err}"
    warned = WARNING.search(outcome.err)
    if warned:
        return "output", f"a warning of Python: {warned.group()}"
    if outcome.code in (2, 3) and not outcome.err.strip():
        return "output", f"exit code {outcome.code} without a word"
    if outcome.code in (0, 4) and "--json" in case.arguments:
        try:
            told = json.loads(outcome.out, parse_constant=_refuse)
        except ValueError as error:
            return "output", f"no JSON: {error}: {outcome.out[:300]}"
        return _lost(case, told, outcome, seeds)
    return "", ""


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is no JSON")


def _lost(case: Case, words: dict[str, Any], outcome: Outcome, seeds: Seeds) -> tuple[str, str]:
    found = None
    if case.kind == "logs" and "--bus-only" in case.arguments:
        found = _lost_frames(case, words, outcome, seeds)
    elif case.kind == "tables" and case.arguments[0] == "check" and case.expected is not None:
        found = _lost_rows(case, words)
    elif case.kind == "dbcs":
        found = _lost_messages(case, outcome)
    return ("loss", found) if found else ("", "")


def _lost_frames(case: Case, words: dict[str, Any], outcome: Outcome, seeds: Seeds) -> str | None:
    """Fewer frames than the file still shows, and nothing was refused."""
    frames = words["frames"]
    if words["refused"] or outcome.err:
        return None
    shown = seeds.frames
    if case.mutated.suffix not in (".blf", ".gz", ".mf4"):
        sound = (seeds.folder / case.mutated.name).read_bytes()
        shown = min(shown, frames_shown(case.mutated.read_bytes(), sound))
    return f"{frames} frames of {shown}, and nothing was refused" if frames < shown else None


def frames_shown(present: bytes, sound: bytes) -> int:
    """Lines that are sound frames, and lines that are damaged but began as no line of the head."""
    known = [line.strip() for line in sound.splitlines()]
    frames = {line for line in known if FRAME.search(line)}
    heads = tuple(line[:8] for line in known if line and line not in frames)
    found = [line.strip() for line in present.splitlines() if line.strip()]
    return sum(line in frames or not line.startswith((*heads, b";")) for line in found)


def _lost_rows(case: Case, words: dict[str, Any]) -> str | None:
    refused = sum(n for reason, n in words["refused"].items() if reason not in NOT_LOST)
    kept = words["samples"]["count"]
    if case.expected is None or kept + refused >= case.expected:
        return None
    return f"{kept} samples and {refused} refused of {case.expected} rows"


def _lost_messages(case: Case, outcome: Outcome) -> str | None:
    text = case.mutated.read_bytes().decode("cp1252", "replace")
    declared = len(re.findall(r"(?m)^BO_ \d+ \w+ *:", text))
    try:
        known = len(load_catalog(case.mutated).names)
    except CatalogError:
        return None
    if known >= declared or outcome.err:
        return None
    return f"{known} messages of {declared} that the DBC declares"
