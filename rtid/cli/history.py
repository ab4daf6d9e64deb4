"""`rtid history`: what was added to the model and dropped, when, why, and what it brought."""

from __future__ import annotations

import json

from rtid.cli.options import AsJson, ProjectOption


def history(
    project: ProjectOption,
    as_json: AsJson = False,
) -> None:
    """List the changes of the model: date, effect, errors before and after, noise floor, reason."""
    from rtid.revised_text import SCHEMA, plain, show_history
    from rtid.revising import history as changes_of

    changes = changes_of(project)
    if as_json:
        print(json.dumps({"schema": SCHEMA, "changes": [plain(change) for change in changes]}))
    else:
        show_history(changes)
