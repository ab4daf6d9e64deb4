"""The exported C, compiled: its flows and commands against Python's, float and fixed point."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge.lookup import NONE, Table
from rtid.estimator.published import publish
from rtid.maps.c_header import BESIDE, NoHeaderError, write_header
from rtid.maps.lookup import Sampled
from rtid.plain import FloatArray
from tests.bridge.controller import COMPILER, SANITISE, STRICT
from tests.flow_maps import machine, orifice, solved

HARNESS = """
#include "maps.h"
#include <stdio.h>
int main(void)
{
    float in[3];
    while (fread(in, sizeof in, 1, stdin) == 1) { /* u, dp, q */
        float out[8];
        int32_t q, u;
        out[0] = (float)rtid_map_flow(&rtid_edge_e1, in[0], in[1], &out[1]);
        out[2] = (float)rtid_map_command(&rtid_edge_e1, in[2], in[1], &out[3]);
        out[4] = (float)rtid_map_fixed_flow(&rtid_edge_e1_fixed, (int32_t)(1e6f * in[0]),
                                            (int32_t)in[1], &q);
        out[5] = (float)q * 1e-9f;
        out[6] = (float)rtid_map_fixed_command(&rtid_edge_e1_fixed, (int32_t)(1e9f * in[2]),
                                               (int32_t)in[1], &u);
        out[7] = (float)u * 1e-6f;
        fwrite(out, sizeof out, 1, stdout);
    }
    return 0;
}
"""
N = 30_000


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[Sampled, ...]]:
    folder, model = tmp_path_factory.mktemp("c"), machine(edges=2)
    flow_map = publish(solved(model, orifice, np.random.default_rng(0)))
    return folder, write_header(folder / "maps.h", model, flow_map, {"project": "x */ y"})


@pytest.fixture(scope="module", params=["-O2", "sanitised"])
def evaluated(
    request: pytest.FixtureRequest, written: tuple[Path, tuple[Sampled, ...]]
) -> tuple[Table, FloatArray, FloatArray]:
    """The table, points (n, 3) and what C says of them (n, 8)."""
    if COMPILER is None:
        pytest.skip("no compiler")
    folder, found = written
    (folder / "main.c").write_text(HARNESS)
    options = SANITISE if request.param == "sanitised" else (request.param,)
    sources = ["main.c", "rtid_map.c", "rtid_map_fixed.c"]
    command = [COMPILER, *STRICT, *options, *sources, "-lm", "-o", f"harness{request.param}"]
    subprocess.run(command, check=True, cwd=folder)
    table, rng = found[1].table, np.random.default_rng(3)
    largest = np.abs(table.flow_m3s).max()
    points = np.stack(
        [
            np.rint(1e6 * rng.uniform(-1, 9, N)) * 1e-6,
            np.rint(rng.uniform(-0.6e6, 7.5e6, N)),
            np.rint(1e9 * rng.uniform(-0.1, 1.1, N) * largest) * 1e-9,
        ],
        axis=1,
    ).astype(np.float32)
    done = subprocess.run(
        [folder / f"harness{request.param}"], input=points.tobytes(), capture_output=True,
        check=True,
    )  # fmt: skip
    out = np.frombuffer(done.stdout, np.float32).reshape(N, 8).astype(float)
    return table, points.astype(float), out


def test_float_is_pythons_to_1e_6(evaluated: tuple[Table, FloatArray, FloatArray]) -> None:
    table, (u, dp, q), out = evaluated[0], evaluated[1].T, evaluated[2]
    largest = np.abs(table.flow_m3s).max()
    flow, stands_on = table.flow(u, dp)
    assert np.abs(out[:, 1] - flow).max() <= 1e-6 * largest
    assert (out[:, 0] == stands_on).mean() > 0.9999
    command, stands_on = table.command(q, dp)
    same = out[:, 2] == stands_on
    assert same.mean() > 0.999
    steep = same & (stands_on != NONE) & (np.abs(dp) > 1e4)
    again = table.flow(out[steep, 3], dp[steep])[0]
    assert np.abs(again - table.flow(command[steep], dp[steep])[0]).max() <= 1e-6 * largest


def test_fixed_point_is_close(evaluated: tuple[Table, FloatArray, FloatArray]) -> None:
    table, (u, dp, q), out = evaluated[0], evaluated[1].T, evaluated[2]
    largest = np.abs(table.flow_m3s).max()
    flow, stands_on = table.flow(u, dp)
    near = np.abs(out[:, 5] - flow).max() / largest
    print(f"\nfixed point: {near:.1e} of the largest flow")
    assert near <= 5e-5
    assert (out[:, 4] == stands_on).mean() > 0.999
    command, stands_on = table.command(q, dp)
    found = (out[:, 6] != NONE) & (stands_on != NONE) & (np.abs(dp) > 1e4)
    assert found.mean() > 0.9 * (stands_on != NONE).mean()
    again, wanted = (
        table.flow(out[found, 7], dp[found])[0],
        table.flow(command[found], dp[found])[0],
    )
    assert np.abs(again - wanted).max() <= 1e-4 * largest


def test_the_functions_come_with_the_tables(written: tuple[Path, tuple[Sampled, ...]]) -> None:
    folder, found = written
    assert {path.name for path in folder.glob("*.[ch]")} >= {"maps.h", *BESIDE}
    assert not list(folder.glob("*.part"))
    text = (folder / "maps.h").read_text()
    assert '"x * / y"' in text and "rtid_edge_e0" in text and len(found) == 2


def test_numbers_that_do_not_fit(written: tuple[Path, tuple[Sampled, ...]]) -> None:
    from rtid.maps.c_header import _whole

    with pytest.raises(NoHeaderError, match="32 bits"):
        _whole("rtid_edge_pa", np.array([1.0, 3000.0]), 1e6)


def test_the_header_says_its_units(written: tuple[Path, tuple[Sampled, ...]]) -> None:
    text = (written[0] / "maps.h").read_text()
    assert "NAME_u: V" in text and "sqrt(Pa)" in text and "NAME_q: m3/s over the scale" in text
