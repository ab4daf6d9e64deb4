"""What `rtid --help` teaches beside the options: which command is for what, and one line to try."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from shlex import quote
from typing import Any

PANELS = {
    "First steps": ("demo", "quick", "init", "check", "simulate"),
    "With a recorded trace: learn, see where the model fails, find out why, add it": (
        *("replay", "compare", "diagnose", "add", "drop", "undo", "history"),
        *("ui", "report", "effects", "excite", "refit"),
    ),
    "On the machine": ("run", "status", "accept", "restore", "apply"),
    "Take it along": ("export", "mcu", "fleet", "trust"),
}

EXAMPLES = {
    "demo": "rtid demo --pictures pictures",
    "quick": "rtid quick run.blf --dbc machine.dbc --bore 63 --rod 36 --stroke 500 --save m.toml",
    "init": "rtid init machine.dbc -o machine.toml",
    "check": "rtid check run.blf -p machine.toml",
    "simulate": "rtid simulate run.blf --plant 3 --motion rich_record --hide backlash=middle",
    "replay": "rtid replay run.blf -p machine.toml --pictures pictures",
    "compare": "rtid compare run.blf -p machine.toml --map data_sheet.csv --span 12:15",
    "diagnose": "rtid diagnose run.blf -p machine.toml",
    "add": "rtid add internal_leakage_laminar run.blf -p machine.toml",
    "drop": "rtid drop internal_leakage_laminar run.blf -p machine.toml",
    "undo": "rtid undo -p machine.toml",
    "history": "rtid history -p machine.toml",
    "ui": "rtid ui run.blf -p machine.toml",
    "report": "rtid report run.blf -p machine.toml -o run.html",
    "effects": "rtid effects internal_leakage_laminar",
    "excite": "rtid excite -p machine.toml --out motion.csv --see valve_seat_leakage",
    "refit": "rtid refit drive.toml drive.csv --diagnose",
    "run": "rtid run machine.toml --bus socketcan:can0",
    "status": "rtid status machine.toml",
    "accept": "rtid accept machine.toml --reason 'new piston seal'",
    "restore": "rtid restore -p machine.toml 17953830",
    "apply": "rtid apply machine.toml --dry-run",
    "export": "rtid export run.blf maps.csv -p machine.toml",
    "mcu": "rtid mcu c -p machine.toml --chamber a --blocks 64",
    "trust": "rtid trust machine.toml",
    "fleet": "rtid fleet traces -o results -p machine.toml",
}
# What to do behind a command that has gone well; {trace}, {project}: its own files.
NEXT = {
    "check": "rtid diagnose {trace} -p {project}",
    "simulate": "rtid diagnose {trace} -p {project}",
    "simulate equations": "rtid refit {project} {trace} --diagnose",
    "simulate live": "",  # nothing is written that a command could read
    "replay": "rtid diagnose {trace} -p {project}",
    "compare": "rtid diagnose {trace} -p {project}",
    "diagnose": "rtid ui {trace} -p {project}",
    "diagnose missing": "rtid add {trace} -p {project} adds what is named; "
    "rtid ui {trace} -p {project} shows it",
    "diagnose ambiguous": "rtid excite -p {project} --out motion.csv designs a motion that tells "
    "them apart; rtid ui {trace} -p {project} shows them",
    "diagnose matches": "rtid export {trace} maps.csv -p {project}; "
    "rtid report {trace} -p {project}",
    "diagnose unknown": "rtid ui {trace} -p {project} shows where the model fails, and over what",
    "diagnose insufficient_data": "rtid excite -p {project} --out motion.csv designs a motion that "
    "shows more",
    "add": "rtid report {trace} -p {project}; rtid export {trace} maps.csv -p {project}",
    "drop": "rtid diagnose {trace} -p {project}",
    "undo": "rtid history -p {project}",
    "history": "rtid diagnose TRACE -p {project}",
    "history changed": "rtid diagnose TRACE -p {project}; rtid undo -p {project} takes a change "
    "back",
    "report": "open it and print it; rtid export {trace} maps.csv -p {project}",
    "excite": "drive it, record it, and rtid check RECORD -p {project}",
    "status": "rtid ui {project} shows it in the browser",
    "accept": "rtid status {project}",
    "restore": "rtid run {project}",
    "apply": "rtid status {project}",
    "export": "rtid report {trace} -p {project} says what the maps stand on",
    "trust": "rtid check TRACE -p {project}",
    "fleet": "rtid diagnose TRACE -p {project} of the machine that leads the ranking",
}
FILES = ("trace", "files", "source", "words", "project", "where", "file")  # that name them
# parameters behind which a program reads, or which need no project
QUIET = ("as_json", "metrics", "board", "serve", "bus_only")
GUIDE = "Where to begin, by task: docs/guide.md in the repository."


def panel(command: str) -> str:
    """The heading under which a command is listed."""
    return next(title for title, names in PANELS.items() if command in names)


def next_step(command: str, given: Mapping[str, Any], outcome: str | None = None) -> str:
    """What to do behind a command, with the files that it was given; "" for nothing.

    outcome: what the command has found, where that decides.
    """
    if command not in NEXT or any(given.get(name) for name in QUIET):
        return ""
    words = [given[name] for name in FILES if given.get(name)]
    every = [str(one) for word in words for one in (word if isinstance(word, list) else [word])]
    project = next((w for w in every if w.endswith(".toml")), None)
    trace = next((w for w in every if "." in w and not w.endswith(".toml")), "TRACE")
    if command == "simulate":
        project = str(Path(trace).with_suffix(".toml"))
    beside = str(given.get("where") or "PROJECT")  # a state folder
    step = NEXT.get(f"{command} {outcome}", NEXT[command])
    step = step.format(trace=quote(trace), project=quote(project or beside))
    return f"Next: {step}" if step else ""
