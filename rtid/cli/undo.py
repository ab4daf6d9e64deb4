"""`rtid undo`: take the last change of the model back."""

from __future__ import annotations

import json

from rtid.cli.options import AsJson, ProjectOption


def undo(
    project: ProjectOption,
    as_json: AsJson = False,
) -> None:
    """Restore the project file as it was before the last change, byte for byte; repeatable."""
    from rtid.revised_text import as_json as plain
    from rtid.revised_text import show
    from rtid.revising import undo as undo_change

    done = undo_change(project)
    if as_json:
        print(json.dumps(plain(done)))
    else:
        show(done)
