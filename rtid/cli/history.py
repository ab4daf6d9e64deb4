"""`rtid history`: the changes of the model, and the points in time of what was learned."""

from __future__ import annotations

import json

from rtid.cli.options import AsJson, ProjectOption


def history(
    project: ProjectOption,
    as_json: AsJson = False,
) -> None:
    """List the changes of the model, and the points in time that `rtid restore` goes back to.

    Of a change: date, effect, errors before and after, noise floor, reason.  Of a point: when and
    why the daemon kept it, and the key of the project file as it was then.
    """
    from rtid.project.history import history as changes_of
    from rtid.project.history import state_beside
    from rtid.tell.history import SCHEMA, plain, show_history, show_points
    from rtid.trace.points import points_of

    changes, folder = changes_of(project), state_beside(project)
    points = [(key.name, p) for key in sorted(folder.glob("*/")) for p in points_of(key)]
    if as_json:
        words = [
            {"name": p.path.stem, "unix_s": p.unix_s, "reason": p.reason, "bytes": p.size_bytes,
             "key": key}
            for key, p in points
        ]  # fmt: skip
        made = [plain(change) for change in changes]
        print(json.dumps({"schema": SCHEMA, "changes": made, "points": words}))
    else:
        show_history(changes)
        show_points([(p.path.stem, p.unix_s, p.reason, key) for key, p in points])
