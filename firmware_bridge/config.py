"""How frames become samples: which signal of which message plays which role, and when it was taken.

Built from the project file by `rtid.project`; the bridge itself knows no project file and nothing
of estimation.
"""

from __future__ import annotations

from dataclasses import dataclass

CYCLE = "cycle"  # all messages belong to one controller cycle: one sample per cycle
FOUND, ANY = "found", "any"  # source addresses of J1939 that are not known before
MULTIRATE = "multirate"  # messages have their own periods: one sample per instant of any of them


@dataclass(frozen=True)
class SignalSource:
    """One role: SI value = factor * physical + offset, or np.interp(physical, *table) if given.

    `message` and `signal` name the DBC message and signal; for a table source `signal` is the
    column.  `constant` replaces the measurement (a tank pressure nobody measures).  hold = "zero"
    for a command that acts until the next one, "linear" for a quantity sampled between instants.
    A `command` with hold = "linear" is a sampled monitor of a faster signal: a sample carries its
    mean over the interval up to the next sample.  late_rows: by so many a table writes it late.
    """

    name: str
    message: str = ""
    signal: str = ""
    factor: float = 1.0
    offset: float = 0.0
    table: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    constant: float | None = None
    hold: str = "linear"
    command: bool = False
    late_rows: int = 0


@dataclass(frozen=True)
class MessageSource:
    """One message: nominal period, age of its values at the time stamp, end-to-end protection.

    t_signal = t_frame - offset_s.  `counter` and `crc` name its alive counter and CRC-8 signal.
    `address`: source address of a J1939 message, FOUND or ANY; None: as the DBC's identifier says.
    """

    name: str
    period_s: float
    offset_s: float = 0.0
    counter: str | None = None
    crc: str | None = None
    data_id: int = 0
    channel: int | None = None
    address: int | str | None = None


@dataclass(frozen=True)
class Assembly:
    """Everything that the assembler needs; `row_signal` is the position: it makes the rows.

    average_s: of the windows whose means are the samples, 0 for none; ahead: signals of which a
    sample then carries the mean from its own window to the next one, each with the name that this
    mean has: its own, or that of one more signal.
    """

    mode: str
    signals: tuple[SignalSource, ...]
    messages: tuple[MessageSource, ...]
    row_signal: str
    max_gap_s: float = 0.05
    average_s: float = 0.0
    ahead: tuple[tuple[str, str], ...] = ()
