"""The controller's map against Python's evaluator of the same table: flow, status, command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge import lookup
from firmware_bridge.download import Image, Session, download
from firmware_bridge.lookup import NONE, OUTSIDE, SHUT, STATUS, ImageError, Table
from tests.bridge.controller import Controller, Line
from tests.bridge.tables import a_table


def holding(table: Table) -> Controller:
    """A controller with this table in slot 0."""
    controller = Controller(1)
    session = Session(Line(controller))
    session.open()
    download(session, {0: Image(lookup.image(table, 0))}, 1)
    return controller


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("size", [(2, 2), (20, 15), (120, 60)])
def test_flow_is_pythons_to_1e_6(size: tuple[int, int], direction: int) -> None:
    table = a_table(*size, direction=direction)
    controller, rng = holding(table), np.random.default_rng(1)
    u = (direction * rng.uniform(-1, 11, 100_000)).astype(np.float32)
    dp = rng.uniform(-4e5, 8e6, 100_000).astype(np.float32)
    q, status = controller.flow(0, u, dp)
    expected, stands_on = table.flow(u, dp)
    largest = np.abs(expected).max()
    print(f"{size}: {np.abs(q - expected).max() / largest:.1e} of the largest flow")
    assert np.abs(q - expected).max() <= 1e-6 * largest
    if min(size) > 2:  # one cell from -20 % to 100 % of the flow rounds by its largest corner
        some = np.abs(expected) > 0.05 * largest
        assert np.abs(q[some] / expected[some] - 1).max() <= 1e-6
    assert (status != stands_on).mean() < 1e-4  # points within rounding of a node
    assert len(np.unique(status)) >= min(6, 2 + (size[0] - 1) * (size[1] - 1))


def test_command_is_pythons_and_gives_the_flow() -> None:
    table = a_table(40, 30)
    controller, rng = holding(table), np.random.default_rng(2)
    dp = rng.uniform(-2e5, 6.5e6, 100_000).astype(np.float32)
    u = rng.uniform(1.5, 10, 100_000).astype(np.float32)
    q = controller.flow(0, u, dp)[0]
    back, status = controller.command(0, q, dp)
    expected, stands_on = table.command(q, dp)
    assert (status != stands_on).mean() < 1e-3
    same = status == stands_on
    assert np.abs(back - expected)[same & (np.abs(dp) > 1e4)].max() < 2e-3
    found = status != NONE
    assert found.mean() > 0.95
    again = controller.flow(0, back[found], dp[found])[0]
    largest = np.abs(q).max()
    print(f"Q(Q^-1(q)) - q: {np.abs(again - q[found]).max() / largest:.1e} of the largest flow")
    assert np.abs(again - q[found]).max() <= 1e-6 * largest


def test_the_command_rises_with_the_wanted_flow() -> None:
    controller = holding(a_table(40, 30))
    for dp in (1e3, 1e5, 3e6):
        q = np.linspace(0.0, 1e-3, 2000)
        u, status = controller.command(0, q, dp)
        assert (np.diff(u[status != NONE]) >= 0).all()


def test_a_flow_that_no_single_command_gives() -> None:
    table = a_table(10, 8)
    hump = np.array(table.counts)
    hump[7:] = hump[6] - (hump[7:] - hump[6])  # closes again
    folded = replace(table, counts=hump)
    assert (np.diff(folded.counts[:, -1].astype(int)) < 0).any()
    controller, dp = holding(folded), 6.5e6
    top, between = folded.scale * hump[6, -1], folded.scale * hump[-1, -1]
    q = np.array([0.5 * (top + between), 2 * top, np.nan])
    u, status = controller.command(0, q, dp)
    assert (status == NONE).all()
    np.testing.assert_array_equal(status, folded.command(q, dp)[1])
    np.testing.assert_allclose(u, folded.command(q, dp)[0], rtol=1e-6)


@pytest.mark.parametrize("direction", [1, -1])
def test_shut_outside_and_no_number(direction: int) -> None:
    table = a_table(direction=direction)
    controller = holding(table)
    u = direction * np.array([0.5, 1.0, -3.0, 20.0, 5.0, np.nan, 5.0, np.inf])
    dp = np.array([1e6, 1e6, 1e6, 1e6, 1e9, 1e6, np.nan, 1e6])
    q, status = controller.flow(0, u, dp)
    assert [STATUS[k] for k in status] == ["shut"] * 3 + ["outside"] * 2 + ["none"] * 3
    assert np.isfinite(q).all() and (q[:3] == 0).all() and (q[5:] == 0).all()
    assert q[3] == controller.flow(0, direction * table.w_v[-1], 1e6)[0]
    np.testing.assert_array_equal(status, table.flow(u, dp)[1])
    assert controller.command(0, 0.0, 1e6)[0] == direction * table.safe_band_v
    assert {SHUT, OUTSIDE, NONE} <= set(status.tolist())


def test_without_a_map_nothing_flows() -> None:
    q, status = Controller(1).flow(0, [5.0], [1e6])
    assert (q[0], status[0]) == (0.0, NONE)
    u, status = Controller(1).command(0, [1e-4], [1e6])
    assert (u[0], status[0]) == (0.0, NONE)


@given(st.integers(2, 255), st.integers(2, 60), st.integers(0, 2**32 - 1), st.sampled_from([1, -1]))
def test_image_round_trip(nu: int, ns: int, seed: int, direction: int) -> None:
    table = a_table(nu, ns, seed, direction)
    back = lookup.table_of(lookup.image(table, 3))
    for name in ("w_v", "s", "counts", "status"):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))
    assert (back.scale, back.safe_band_v, back.direction) == (
        table.scale, table.safe_band_v, direction,
    )  # fmt: skip


@given(st.binary(max_size=200))
def test_other_bytes_are_no_image(data: bytes) -> None:
    for read in (lookup.table_of, lookup.numbers_of):
        try:
            read(data)
        except ImageError:
            continue
        assert len(data) >= lookup.HEAD.size


def test_what_is_too_large_is_refused() -> None:
    with pytest.raises(ImageError, match="per axis"):
        lookup.image(a_table(300, 3), 0)
    with pytest.raises(ImageError, match="1 to 255"):
        lookup.numbers_image([], 0)
