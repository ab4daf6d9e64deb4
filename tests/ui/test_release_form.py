"""The release of maps from the page: what is typed, what is refused, and who may take the files."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtid.errors import RtidError
from rtid.maps.flashed import FlashedMap
from rtid.maps.release import Room
from rtid.ui.release_form import Released, ReleaseWish, controls, room_of, shown

FLASHED = (FlashedMap.__new__(FlashedMap),)


@pytest.mark.parametrize(
    ("room", "typed", "asked"),
    [
        ("tolerance", "", Room()),
        ("tolerance", "0,5", Room(share=0.005)),
        ("nodes", "16x12", Room(nodes=(16, 12))),
        ("bytes", "8 192", Room(n_bytes=8192)),
        ("axes", "", Room(axes=FLASHED)),
    ],
)
def test_what_is_typed_is_the_room(room: str, typed: str, asked: Room) -> None:
    assert room_of(ReleaseWish(room=room, amount=typed), FLASHED) == asked


@pytest.mark.parametrize(
    ("room", "typed"),
    [
        ("tolerance", "99"),
        ("nodes", "16"),
        ("bytes", "8k"),
        ("bytes", "-1"),
        ("", "1"),
        ("axes", ""),
    ],
)
def test_what_is_no_room_is_refused_in_words(room: str, typed: str) -> None:
    with pytest.raises(RtidError, match=r"cannot be that|nothing is chosen"):
        room_of(ReleaseWish(room=room, amount=typed), ())


def test_names_of_files_are_escaped() -> None:
    evil = '"><img src=x>.dcm'
    released = Released((Path(evil),), ((evil,) * 7,), ())
    assert "<img" not in shown(released) + controls(ReleaseWish(amount=evil), [evil], [evil])
