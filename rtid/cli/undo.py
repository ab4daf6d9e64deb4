"""`rtid undo`: take the last change of the model back."""

from __future__ import annotations

from rtid.cli.options import AsJson, ProjectOption, UnitsOption
from rtid.units import System


def undo(
    project: ProjectOption, as_json: AsJson = False, units: UnitsOption = System.DISPLAY
) -> None:
    """Restore the project file as it was before the last change, byte for byte; repeatable."""
    from rtid.study.revisions import undo as undo_change
    from rtid.tell.revised import show

    show(undo_change(project), as_json)
