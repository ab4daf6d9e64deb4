from __future__ import annotations

import math
from collections import OrderedDict
from typing import Any

import numpy as np
import pytest
from cantools.database import Message
from cantools.database.can import Database, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge import bits, e2e
from firmware_bridge.catalog import Catalog, CatalogError, load
from firmware_bridge.encode import encode_message
from tests.bridge.machine import CATALOG
from tests.bridge.test_e2e import plain_crc


def signal(start: int, length: int, order: Any, **more: Any) -> Signal:
    conversion = BaseConversion.factory(
        scale=more.pop("scale", 1), offset=more.pop("offset", 0), is_float=more.pop("float", False)
    )
    return Signal("S", start, length, order, conversion=conversion, **more)


def catalog_of(*signals: Signal) -> Catalog:
    message = Message(0x100, "M", 8, list(signals), strict=False)
    return Catalog(Database([message]))


@st.composite
def one_signal(draw: st.DrawFn) -> Signal:
    kind = draw(st.sampled_from(["unsigned", "signed", "float32", "float64"]))
    lengths = {"float32": 32, "float64": 64}
    length = lengths.get(kind) or draw(st.integers(1, 64))
    first = draw(st.integers(0, 64 - length))
    order = draw(st.sampled_from(["little_endian", "big_endian"]))
    start = first if order == "little_endian" else 8 * (first // 8) + 7 - first % 8
    scale = draw(st.sampled_from([1, 3, 0.25, 1e-3, 152.59021896696422, -0.5]))
    return signal(
        start, length, order, is_signed=kind == "signed", float=kind.startswith("float"),
        scale=scale, offset=draw(st.sampled_from([0, -40, 0.1])),
    )  # fmt: skip


def same(ours: float, theirs: float) -> bool:
    if math.isnan(theirs) or math.isinf(theirs):
        return math.isnan(ours) or ours == theirs
    return ours == pytest.approx(theirs, rel=1e-15, abs=0.0)


@settings(max_examples=300, deadline=None)
@given(one_signal(), st.binary(min_size=8, max_size=8))
def test_decoding_equals_cantools(defined: Signal, payload: bytes) -> None:
    catalog = catalog_of(defined)
    theirs: Any = catalog.message("M").decode(payload, decode_choices=False)
    ours = catalog.layouts("M").decode(np.frombuffer(payload, np.uint8).reshape(1, 8))
    assert same(float(ours[0, 0]), float(theirs["S"]))


@settings(max_examples=200, deadline=None)
@given(one_signal(), st.data())
def test_encoding_round_trip(defined: Signal, data: st.DataObject) -> None:
    catalog = catalog_of(defined)
    layouts = catalog.layouts("M")
    payload = data.draw(st.binary(min_size=8, max_size=8))
    value = layouts.decode(np.frombuffer(payload, np.uint8).reshape(1, 8))
    again = layouts.decode(layouts.encode(value))
    if np.isfinite(value).all():
        exact = abs(float(value[0, 0])) < 1e300
        assert not exact or again == pytest.approx(value, rel=1e-6, abs=2 * abs(defined.scale))


def test_all_own_messages_decode_like_cantools() -> None:
    rng = np.random.default_rng(1)
    for name in CATALOG.names:
        payloads = rng.integers(0, 256, (200, 8), np.uint8)
        layouts = CATALOG.layouts(name)
        ours = layouts.decode(payloads)
        message = CATALOG.message(name)
        for payload, row in zip(payloads, ours, strict=True):
            theirs: Any = message.decode(bytes(payload), decode_choices=False, scaling=True)
            for key, value in zip(layouts.names, row, strict=True):
                assert np.isnan(value) or value == theirs[key]


def test_kernels_run_the_same_uncompiled() -> None:
    rng = np.random.default_rng(2)
    layouts = CATALOG.layouts("Motion")
    words = rng.integers(0, 2**63, 20).astype(np.uint64)
    with np.errstate(over="ignore"):
        plain = bits.decode_words.py_func(words, layouts.rows.view(np.recarray), 5, layouts.codes)
    fast = bits.decode_words(words, layouts.rows, 5, layouts.codes)
    np.testing.assert_array_equal(plain, fast)


def test_rig_counts_survive_without_extra_quantisation() -> None:
    counts = np.arange(0, 65535, 7)
    columns = {
        ("ValveCommand", "U"): (20 / 65535, -10.0),
        ("ValveCommand", "PTank"): (1e7 / 65535, 0.0),
        ("Pressures", "PA"): (1e7 / 65535, 0.0),
        ("Motion", "X"): (0.5 / 65535, 0.0),
        ("Motion", "V"): (1 / 65535, -0.5),
    }
    for (message, name), (scale, offset) in columns.items():
        value: Any = offset + scale * counts
        layouts = CATALOG.layouts(message, [name])
        back = layouts.decode(layouts.encode(value[:, None]))[:, 0]
        np.testing.assert_allclose(back, value, rtol=1e-12, atol=1e-9 * scale)


def test_out_of_range_and_saturation_are_not_available() -> None:
    layouts = CATALOG.layouts("Pressures", ["PA"])
    values = np.array([[np.nan], [0.0], [9.9e6], [2e7]])
    back = layouts.decode(layouts.encode(values))[:, 0]
    assert np.isnan(back[0])
    assert back[1] == 0.0
    assert back[2] == pytest.approx(9.9e6, abs=80)
    assert back[3] < 1e7  # saturates at the largest valid value
    raw = np.zeros((1, 8), np.uint8)
    raw[0, 2:4] = 0xFF
    assert np.isnan(layouts.decode(raw)[0, 0])


def test_named_absent_code_is_not_available() -> None:
    from cantools.database.namedsignalvalue import NamedSignalValue

    conversion = BaseConversion.factory(choices=OrderedDict({255: NamedSignalValue(255, "SNA")}))
    catalog = catalog_of(Signal("S", 0, 8, conversion=conversion))
    payloads = np.zeros((2, 8), np.uint8)
    payloads[1, 0] = 255
    np.testing.assert_array_equal(catalog.layouts("M").decode(payloads)[:, 0], [0.0, np.nan])


def test_multiplexed_equals_cantools() -> None:
    selector = Signal("Page", 0, 4, is_multiplexer=True)
    inner = Signal("Inner", 4, 4, is_multiplexer=True, multiplexer_ids=[1],
                   multiplexer_signal="Page")  # fmt: skip
    parts = [
        Signal("A", 8, 16, multiplexer_ids=[0, 2], multiplexer_signal="Page"),
        Signal("B", 8, 8, multiplexer_ids=[3], multiplexer_signal="Inner"),
    ]
    catalog = catalog_of(selector, inner, *parts)
    rng = np.random.default_rng(3)
    payloads = rng.integers(0, 256, (300, 8), np.uint8)
    payloads[:, 0] = rng.integers(0, 3, 300) + 16 * rng.integers(2, 5, 300)
    layouts = catalog.layouts("M", ["A", "B"])
    ours = layouts.decode(payloads)
    assert np.isfinite(ours).any(axis=0).all()
    for payload, (a, b) in zip(payloads.astype(int), ours, strict=True):
        page, inner_page = payload[0] & 15, payload[0] >> 4
        expect_a = payload[1] + 256 * payload[2] if page in (0, 2) else np.nan
        expect_b = payload[1] if page == 1 and inner_page == 3 else np.nan
        np.testing.assert_array_equal([a, b], [expect_a, expect_b])


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(CatalogError, match="did you mean 'Pressures'"):
        CATALOG.message("Presures")
    with pytest.raises(CatalogError, match="did you mean 'PSupply'"):
        CATALOG.layouts("Pressures", ["PSuply"])


def test_bad_files_are_refused(tmp_path: Any) -> None:
    with pytest.raises(CatalogError, match="no such file"):
        load(tmp_path / "none.dbc")
    (tmp_path / "bad.dbc").write_bytes(b"\x00\xff not a dbc" * 50)
    with pytest.raises(CatalogError, match="not a readable DBC"):
        load(tmp_path / "bad.dbc")
    with pytest.raises(CatalogError, match="float of 16 bits"):
        catalog_of(signal(0, 16, "little_endian", float=True)).layouts("M")


@given(st.binary(min_size=8, max_size=8), st.integers(0, 65535), st.integers(0, 7))
@settings(max_examples=50, deadline=None)
def test_crc_equals_long_division(payload: bytes, data_id: int, crc_byte: int) -> None:
    data = np.frombuffer(payload, np.uint8).reshape(1, 8).copy()
    covered = data_id.to_bytes(2, "little") + payload[:crc_byte] + payload[crc_byte + 1 :]
    assert e2e.crc8_bulk(data, 8, crc_byte, data_id)[0] == plain_crc(covered)


def test_crc8_lets_few_corrupted_payloads_through() -> None:
    rng = np.random.default_rng(4)
    data = rng.integers(0, 256, (100_000, 8), np.uint8)
    data[:, 0] = e2e.crc8_bulk(data, 8, 0, 4640)
    flips = rng.integers(0, 64, (len(data), 5))
    bad = data.copy()
    for k in range(5):
        bad[np.arange(len(data)), flips[:, k] // 8] ^= (1 << (flips[:, k] % 8)).astype(np.uint8)
    changed = (bad != data).any(axis=1)
    passed = changed & (e2e.crc8_bulk(bad, 8, 0, 4640) == bad[:, 0])
    assert passed.sum() / changed.sum() <= 0.0045


def test_alive_counter_counts_on_or_is_given() -> None:
    t_us = np.arange(20, dtype=np.int64)
    rising = encode_message(CATALOG, "Motion", t_us, {"X": 0.1}, counter=14)
    given_ = encode_message(CATALOG, "Motion", t_us, {"X": 0.1}, counter=14 + np.arange(20))
    np.testing.assert_array_equal(rising.data, given_.data)
    counts = CATALOG.layouts("Motion", ["AliveCounter"]).decode(rising.data)[:, 0]
    np.testing.assert_array_equal(counts, (14 + np.arange(20)) % 16)
