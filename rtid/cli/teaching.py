"""What `rtid --help` teaches beside the options: which command is for what, and one line to try."""

from __future__ import annotations

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
GUIDE = "Where to begin, by task: docs/guide.md in the repository."


def panel(command: str) -> str:
    """The heading under which a command is listed."""
    return next(title for title, names in PANELS.items() if command in names)
