"""Assembler: frames in, samples out.

One compiled state machine runs over the frames in their order of arrival and knows no clock, so
pushing frames one by one (live) or a whole log at once (replay) yields bit-identical samples.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import checks, cycle, multirate
from firmware_bridge.catalog import Catalog, Layouts, words_of
from firmware_bridge.config import CYCLE, MULTIRATE, Assembly, MessageSource, SignalSource
from firmware_bridge.frames import EXTENDED, Frames, add_counts
from firmware_bridge.j1939 import known_as
from firmware_bridge.jit import Record, Records
from firmware_bridge.samples import Samples

MAX_MESSAGES = 63
MAX_QUEUE = 1 << 16  # samples per message that may wait for another message


class AssemblyError(ValueError):
    """The declared assembly contradicts itself or the DBC; the text names the place."""


class Assembler:
    """Turns frames into complete samples in SI units, as `assembly` declares.

    `counters` holds how many frames, cycles or instants were refused, by reason (see
    `checks.REASONS`), and what the source left out.  Raises AssemblyError or CatalogError if the
    assembly names what the DBC does not have.
    """

    def __init__(self, catalog: Catalog, assembly: Assembly) -> None:
        self.names = tuple(signal.name for signal in assembly.signals)
        self.assembly = assembly
        self._long = _long_messages(catalog, assembly)
        self._plan = _plan(catalog, assembly)
        names = [message.name for message in assembly.messages]
        rows = [s for s in assembly.signals if s.name == assembly.row_signal]
        if not rows or rows[0].message not in names:
            raise AssemblyError(f"row_signal {assembly.row_signal!r} is no signal of a message")
        self._row_message = names.index(rows[0].message)
        self._lifetime_us = _lifetime_us(self._plan)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next sample starts anew and carries GAP."""
        self._counts = np.zeros(len(checks.REASONS), np.int64)
        self._source_counts: dict[str, int] = {}
        constants = np.array([s.constant if s.constant is not None else np.nan
                              for s in self.assembly.signals])  # fmt: skip
        self._cycle = self._multirate = None
        if self.assembly.mode == CYCLE:
            self._cycle = _cycle_state(self._plan, constants)
        else:
            self._multirate = _multirate_state(self._plan, constants)

    @property
    def counters(self) -> dict[str, int]:
        """Refusals so far by reason; reasons that did not occur are left out."""
        counted = dict(zip(checks.REASONS, self._counts.tolist(), strict=True))
        total: dict[str, int] = {}
        add_counts(total, counted)
        add_counts(total, self._source_counts)
        return total

    @property
    def source_counters(self) -> dict[str, int]:
        """What the source and the gates before this one left out, by reason."""
        return dict(self._source_counts)

    @property
    def declared(self) -> Records:
        """MESSAGE (m,) of the declared messages, in their order."""
        return self._plan.messages

    @property
    def messages(self) -> Records:
        """LAST (m,) of the declared messages, in their order: a view; `gap_us` may be reset."""
        state = self._cycle or self._multirate
        assert state is not None
        return state.last

    def push(self, frames: Frames) -> Samples:
        """The samples that became complete with these frames (n frames, in order of arrival)."""
        add_counts(self._source_counts, frames.refused)
        words = self._words(frames)
        columns = (frames.t_us, frames.channel, frames.can_id, frames.length, words)
        arrays = tuple(np.ascontiguousarray(column) for column in columns)
        if self._cycle is not None:
            return self._push_cycle(arrays)
        return self._push_multirate(arrays)

    def _words(self, frames: Frames) -> NDArray[np.uint64]:
        """What is read of each frame: its first 8 bytes, or the wanted signals of a long one."""
        words = words_of(frames.data)
        for can_id, length, layouts in self._long:
            mine = (frames.can_id == can_id) & (frames.length == length)
            if mine.any():
                words = np.where(mine, 0, words)
                words[mine] = layouts.pack(frames.data[mine])
        return words

    def _push_cycle(self, arrays: tuple[NDArray[np.generic], ...]) -> Samples:
        out = self._room(len(arrays[0]))
        n = cycle.push(
            self._plan, self._cycle, *arrays, self._row_message, self._lifetime_us,
            self._counts, out.t_us, out.values, out.flags,
        )  # fmt: skip
        return _head(out, n)

    def _push_multirate(self, arrays: tuple[NDArray[np.generic], ...]) -> Samples:
        assert self._multirate is not None
        queued = int(self._multirate.queues["count"].sum())
        out = self._room(len(arrays[0]) + queued + 1)
        n = multirate.push(
            self._plan, self._multirate, *arrays, self._row_message,
            self._counts, out.t_us, out.values, out.flags,
        )  # fmt: skip
        return _head(out, n)

    def finish(self) -> Samples:
        """The last sample, if one still waited; what stays incomplete is counted."""
        out = self._room(1)
        if self._cycle is not None:
            cycle.finish(self._cycle, self._counts)
            return _head(out, 0)
        n = multirate.flush(self._multirate, out.t_us, out.values, out.flags)
        multirate.count_unpaired(self._multirate, self._counts)
        return _head(out, n)

    def _room(self, n: int) -> Samples:
        m = len(self.names)
        return Samples(self.names, np.empty(n, np.int64), np.empty((n, m)), np.empty(n, np.uint8))


def _lifetime_us(plan: checks.Plan) -> int:
    """How long a cycle may take from its first frame on."""
    period_us = int(plan.messages["period_us"].max())
    if not _is_counted(plan):
        return period_us // 2
    return period_us * (int(plan.messages["counter_mask"][0]) + 1) // 2


def _is_counted(plan: checks.Plan) -> bool:
    return bool((plan.messages["counter"] >= 0).all())


def _head(out: Samples, n: int) -> Samples:
    return Samples(out.names, out.t_us[:n], out.values[:n], out.flags[:n])


def _cycle_state(plan: checks.Plan, constants: NDArray[np.float64]) -> cycle.State:
    n_slots = int(plan.messages["counter_mask"][0]) + 1 if _is_counted(plan) else 1
    return cycle.State(
        last=np.zeros(len(plan.messages), checks.LAST),
        slots=np.zeros(n_slots, cycle.SLOT),
        values=np.tile(constants, (n_slots, 1)),
        progress=np.zeros(1, cycle.PROGRESS),
        scratch=np.zeros(len(plan.roles)),
    )


def _multirate_state(plan: checks.Plan, constants: NDArray[np.float64]) -> multirate.State:
    n, widest = len(plan.messages), int(plan.messages["n_roles"].max())
    wait_us = 2 * int(plan.messages["limit_us"].max())
    capacity = wait_us // int(plan.messages["period_us"].min()) + 64
    if capacity > MAX_QUEUE:
        raise AssemblyError(
            f"the slowest message may be silent for {wait_us * 5e-7:g} s, {capacity // 2} periods "
            "of the fastest: too many samples would wait; reduce max_gap_s or leave it out"
        )
    pending = np.zeros(1, multirate.PENDING)
    pending["broken"] = True  # the first sample continues nothing
    return multirate.State(
        last=np.zeros(n, checks.LAST),
        queues=np.zeros(n, multirate.QUEUE),
        times=np.zeros((n, capacity), np.int64),
        values=np.zeros((n, capacity, widest)),
        pending=pending,
        row=constants.copy(),
        new_row=constants.copy(),
        scratch=np.zeros(len(plan.roles)),
    )


def _plan(catalog: Catalog, assembly: Assembly) -> checks.Plan:
    """The constant part of the state machine; raises AssemblyError or CatalogError."""
    _check_assembly(assembly)
    _refuse_twins(catalog, assembly)
    messages = np.zeros(len(assembly.messages), checks.MESSAGE)
    roles: list[Record] = []
    layouts, codes, tables = [], [], []
    n_layouts = n_codes = n_table = 0
    for row, source in zip(messages, assembly.messages, strict=True):
        mine = [s for s in assembly.signals if s.constant is None and s.message == source.name]
        chosen = _layouts(catalog, assembly, source)
        chosen = chosen.packed() if chosen.is_long else chosen
        _fill_message(row, catalog, source, assembly, chosen.rows)
        row["first_role"], row["n_roles"] = len(roles), len(mine)
        row["counter"] = n_layouts + len(mine) if source.counter else -1
        for k, signal in enumerate(mine):
            role = _role(signal, assembly, n_layouts + k, n_table)
            roles.append(role)
            if signal.table is not None:
                tables.append(np.array(signal.table, np.float64))
                n_table += role["table_count"]
        layouts.append(_shifted(chosen.rows, n_layouts, n_codes))
        codes.append(chosen.codes)
        n_layouts, n_codes = n_layouts + len(chosen.rows), n_codes + len(chosen.codes)
    if assembly.mode == CYCLE and len(np.unique(messages["counter_mask"])) > 1:
        raise AssemblyError("mode 'cycle': the alive counters must have the same number of bits")
    table = np.concatenate(tables, axis=1) if tables else np.zeros((2, 0))
    return checks.Plan(
        messages, np.array(roles, checks.ROLE), np.concatenate(layouts), np.concatenate(codes),
        np.ascontiguousarray(table),
    )  # fmt: skip


def _layouts(catalog: Catalog, assembly: Assembly, source: MessageSource) -> Layouts:
    """Layouts of what is wanted of a message: its roles, then its counter."""
    mine = [s for s in assembly.signals if s.constant is None and s.message == source.name]
    wanted = [s.signal for s in mine] + ([source.counter] if source.counter else [])
    return catalog.layouts(source.name, wanted)


def _long_messages(catalog: Catalog, assembly: Assembly) -> list[tuple[int, int, Layouts]]:
    """Identifier, length and layouts of messages of which more than the first 8 bytes is read."""
    known = [(source, _layouts(catalog, assembly, source)) for source in assembly.messages]
    return [
        (known_as(catalog, source), catalog.message(source.name).length, layouts)
        for source, layouts in known
        if layouts.is_long
    ]


def _shifted(rows: Records, n_layouts: int, n_codes: int) -> Records:
    """Layout rows whose references point into the common arrays."""
    rows = rows.copy()
    rows["selector"][rows["selector"] >= 0] += n_layouts
    rows["pages_first"] += n_codes
    rows["absent_first"] += n_codes
    return rows


def _check_assembly(assembly: Assembly) -> None:
    if assembly.mode not in (CYCLE, MULTIRATE):
        raise AssemblyError(f"mode {assembly.mode!r}: choose {CYCLE!r} or {MULTIRATE!r}")
    if not 0 < len(assembly.messages) <= MAX_MESSAGES:
        raise AssemblyError(f"{len(assembly.messages)} messages: declare 1 to {MAX_MESSAGES}")
    declared = {message.name for message in assembly.messages}
    for signal in assembly.signals:
        if signal.constant is None and signal.message not in declared:
            raise AssemblyError(
                f"signal {signal.name!r}: message {signal.message!r} is not among the declared "
                f"messages {sorted(declared)}; declare it with its period"
            )
        if signal.hold not in ("zero", "linear"):
            raise AssemblyError(f"signal {signal.name!r}: hold {signal.hold!r} is unknown")
        if signal.table is not None and not (np.diff(signal.table[0]) > 0).all():
            raise AssemblyError(f"signal {signal.name!r}: its table must have increasing x")
    counters = {message.counter is not None for message in assembly.messages}
    if assembly.mode == CYCLE and len(counters) > 1:
        raise AssemblyError("mode 'cycle': declare a counter for all messages or for none")


def _refuse_twins(catalog: Catalog, assembly: Assembly) -> None:
    """AssemblyError for two messages that one frame could be."""
    for first, second in itertools.combinations(assembly.messages, 2):
        can_id = known_as(catalog, first)
        apart = None not in (first.channel, second.channel) and first.channel != second.channel
        if can_id == known_as(catalog, second) and not apart:
            raise AssemblyError(
                f"messages {first.name!r} and {second.name!r} are both 0x{can_id & ~EXTENDED:X}; "
                "give each its channel, or in J1939 its address"
            )


def _fill_message(
    row: Record, catalog: Catalog, source: MessageSource, assembly: Assembly,
    layouts: Records,
) -> None:  # fmt: skip
    """Set one MESSAGE row (changed in place)."""
    if not source.period_s > 0:
        raise AssemblyError(f"message {source.name!r}: period_s must be > 0")
    row["can_id"] = known_as(catalog, source)
    row["channel"] = -1 if source.channel is None else source.channel
    row["length"] = catalog.message(source.name).length
    row["crc_byte"] = -1 if source.crc is None else catalog.byte_of(source.name, source.crc)
    row["data_id"] = source.data_id
    row["period_us"] = max(round(source.period_s * 1e6), 1)
    row["late_us"] = round(source.period_s * 1.5e6)
    row["offset_us"] = round(source.offset_s * 1e6)
    row["limit_us"] = round(max(5 * source.period_s, assembly.max_gap_s) * 1e6)
    if source.counter is not None:
        length = catalog.signal(source.name, source.counter).length
        if length > 8:
            raise AssemblyError(f"{source.name}.{source.counter}: a counter has at most 8 bits")
        row["counter_mask"] = (1 << length) - 1


def _role(signal: SignalSource, assembly: Assembly, layout: int, table_first: int) -> Record:
    role = np.zeros(1, checks.ROLE)[0]
    role["layout"], role["column"] = layout, assembly.signals.index(signal)
    role["factor"], role["offset"] = signal.factor, signal.offset
    linear = checks.MEAN if signal.command else checks.LINEAR
    role["hold"] = checks.ZERO if signal.hold == "zero" else linear
    role["table_first"] = table_first
    role["table_count"] = len(signal.table[0]) if signal.table is not None else 0
    return role
