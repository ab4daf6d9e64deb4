"""Mutations of files: of bytes, of lines, of the values of a TOML file, of the columns of a table.

Each takes a `random.Random` and gives new content; the same seed gives the same content.
"""

from __future__ import annotations

import random
import re
from copy import deepcopy
from typing import Any

import numpy as np
import tomlkit

NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
ODD_NUMBERS = (
    *("0", "-1", "1", "nan", "inf", "-inf", "1e308", "-1e308", "1e-308", "5e-324", "1e400"),
    *("4294967295", "9223372036854775807", "18446744073709551616", "-9223372036854775809"),
    *("1" + 40 * "0", "0x10", "1_000", "1,5", "١٢", "", "--1", "1e", "true", '"x"', "[]"),
)
ODD_TEXTS = (
    *("", " ", "\0", "[red]x[/red]", "[/]", "%s%n", "é😀", "../../etc/passwd", "a" * 5000, "x\ny"),
    *("\x1b[2J", "none", "nan", "u", "p_a", "a.b.c", "\u202e", "'", '"', "\\", "NUL", "-1", "{}"),
)
ODD_BYTES = (b"\0", b"\xff", b"\n", b"\r\n", b"\xef\xbb\xbf", b"\xff\xfe", b'"', b"\t", b"\x1a")


def of_bytes(content: bytes, rng: random.Random) -> bytes:
    """One to four of: flip, cut, drop, double, insert, fill a stretch."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        content = rng.choice(_BYTES)(content, rng)
    return content


def of_text(content: bytes, rng: random.Random) -> bytes:
    """As `of_bytes`, and numbers replaced, lines dropped, doubled, swapped and joined."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        content = rng.choice((*_BYTES, *_LINES, *_LINES))(content, rng)
    return content


def _place(content: bytes, rng: random.Random) -> tuple[int, int]:
    """A stretch; the head of a file is hit as often as all of the rest."""
    reach = len(content) if rng.random() < 0.5 else min(len(content), 200)
    first = rng.randrange(reach + 1) if reach else 0
    return first, first + rng.choice((1, 1, 2, 4, 8, 100, 5000))


def _flip(content: bytes, rng: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 3, 30))):
        if changed:
            changed[min(_place(content, rng)[0], len(changed) - 1)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _cut(content: bytes, rng: random.Random) -> bytes:
    return content[: _place(content, rng)[0]]


def _drop(content: bytes, rng: random.Random) -> bytes:
    first, last = _place(content, rng)
    return content[:first] + content[last:]


def _double(content: bytes, rng: random.Random) -> bytes:
    first, last = _place(content, rng)
    return content[:last] + content[first:]


def _insert(content: bytes, rng: random.Random) -> bytes:
    first = _place(content, rng)[0]
    return content[:first] + rng.choice(ODD_BYTES) * rng.choice((1, 2, 300)) + content[first:]


def _fill(content: bytes, rng: random.Random) -> bytes:
    first, last = _place(content, rng)
    last = min(last, len(content))
    return content[:first] + rng.choice((b"\0", b"\xff", b"9")) * (last - first) + content[last:]


def _number(content: bytes, rng: random.Random) -> bytes:
    found = list(NUMBER.finditer(content))
    if not found:
        return content
    first, last = rng.choice(found if rng.random() < 0.5 else found[:60]).span()
    return content[:first] + rng.choice(ODD_NUMBERS).encode() + content[last:]


def _column_of_numbers(content: bytes, rng: random.Random) -> bytes:
    """The same number of each line becomes the same odd one: a whole column is odd."""
    which, odd = rng.randrange(8), rng.choice(ODD_NUMBERS).encode()
    lines = content.split(b"\n")
    for k, line in enumerate(lines):
        found = list(NUMBER.finditer(line))
        if len(found) > which:
            first, last = found[which].span()
            lines[k] = line[:first] + odd + line[last:]
    return b"\n".join(lines)


def _lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    first, last = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(4)
    if kind == 0:
        lines[first], lines[last] = lines[last], lines[first]
    elif kind == 1:
        lines[first : first + 1] = [lines[first]] * rng.choice((2, 50))
    elif kind == 2:
        del lines[first : first + rng.choice((1, 5, 50))]
    else:
        lines[first] += b" " + lines[last]
    return b"\n".join(lines)


_BYTES = (_flip, _cut, _drop, _double, _insert, _fill)
_LINES = (_number, _column_of_numbers, _lines)


def of_toml(text: str, rng: random.Random) -> bytes:
    """Values, keys or tables of a TOML file changed, so that it stays one.

    Half of the time only by what somebody might have meant, so that not all is refused at once.
    """
    raw = tomlkit.parse(text).unwrap()
    change = rng.choice((_change, _change_plausibly))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        change(raw, rng)
    try:
        return tomlkit.dumps(raw).encode()
    except Exception:  # what TOML cannot say (None, a huge integer); the text itself then
        return of_text(text.encode(), rng)


def _change(raw: dict[str, Any], rng: random.Random) -> None:
    """Change one entry somewhere in nested tables and lists (changed in place)."""
    places = list(_places(raw))
    holder, key = rng.choice(places)
    kind = rng.randrange(10)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[rng.choice(ODD_TEXTS) or "extra"] = deepcopy(holder[key])
    elif kind == 2 and isinstance(holder, dict):
        other = rng.choice(places)
        holder[key] = deepcopy(other[0][other[1]])  # it may be what this one stands in
    else:
        holder[key] = odd_value(holder[key], rng)


CHOICES = (  # words of which one may stand for another
    ("both", "command", "drop"),
    ("taylor", "lapped", "blended"),
    ("integral", "carry", "restart"),
    ("cycle", "multirate"),
    ("zero", "linear", "first"),
    ("same", "estimated"),
    ("level", "pressure", "temperature", "velocity", "displacement", "any"),
    ("V", "A", "%", "mode", "Pa", "bar", "m", "mm", "deg", "m/s"),
    ("u", "p_a", "p_b", "p_supply", "p_tank", "x", "v"),
    ("pa", "at", "pb", "bt"),
)
WORDS = {word: words for words in CHOICES for word in words}
ADDED = {  # keys that most sections of one name may have
    "edges": {"terms": "command", "basis": "blended", "safe_band_v": 0.0},
    "signals": {"noise": "estimate", "resolution": 0.01, "hold": "linear", "constant": 1.0},
    "messages": {"offset_ms": "estimate", "tolerance_ms": 1},
    "states": {"inertia": "2", "low": 0},
}


def _change_plausibly(raw: dict[str, Any], rng: random.Random) -> None:
    """Another size, sign or word that the key knows, or an entry that may stand there as well."""
    section = rng.choice([name for name in ADDED if name in raw] or [""])
    if section and rng.random() < 0.3:
        key, value = rng.choice(list(ADDED[section].items()))
        chosen = list(raw[section].values())
        for entry in chosen if rng.random() < 0.5 else [rng.choice(chosen)]:
            entry[key] = value
        return
    plain = [(h, k) for h, k in _places(raw) if not isinstance(h[k], list | dict)]
    holder, key = rng.choice(
        [(h, k) for h, k in plain if not isinstance(h[k], str) or h[k] in WORDS]
    )
    value = holder[key]
    if isinstance(value, str):
        holder[key] = rng.choice(WORDS[value])
    elif isinstance(value, bool):
        holder[key] = not value
    else:
        factor = rng.choice((0, 0.1, 0.5, 0.9, 1.1, 2, 10, 100))
        holder[key] = type(value)(value * factor)


def _places(raw: Any) -> Any:
    entries = raw.items() if isinstance(raw, dict) else enumerate(raw)
    for key, value in entries:
        yield raw, key
        if isinstance(value, dict | list):
            yield from _places(value)


def odd_value(value: Any, rng: random.Random) -> Any:
    """Something else in its place: near it, of another size, or of another kind."""
    if isinstance(value, int | float) and not isinstance(value, bool) and rng.random() < 0.7:
        factors = (0, -1, 1e-9, 1e-3, 0.5, 2, 1e3, 1e9, 1e300, float("nan"), float("inf"))
        return value * rng.choice(factors) if rng.random() < 0.9 else -value - 1
    if isinstance(value, str) and rng.random() < 0.5:
        return rng.choice((value.upper(), value + " ", value[:-1], value * 3, f"({value})"))
    if isinstance(value, str) and rng.random() < 0.3:
        return formula(rng)
    odd: tuple[Any, ...] = (0, -1, 1, 2**31, 2**63 - 1, 0.5, 1e308, True, [], {}, "", [1], [[]])
    more: tuple[Any, ...] = ({"start": [1], "stop": 2, "step": 1}, [0, 0], [1, 0], {"a": {}})
    return rng.choice((*odd, *more, *ODD_TEXTS, list(range(300)), [float("nan"), 1.0]))


def formula(rng: random.Random) -> str:
    """A formula that is deep, long, huge, or none."""
    n = rng.choice((3, 90, 400, 2000))
    name = rng.choice(("p_a", "x1", "u", "1", "9e99"))
    kinds = (
        "max(" + ", ".join([name] * n) + ")",
        "(" * n + name + ")" * n,
        "+".join([name] * n),
        "-" * n + name,
        "**".join([name] * min(n, 9)),
        "exp(" * n + name + ")" * n,
        f"{name}/0",
        f"log(-1)*{name}",
        f"{name} if {name} else 0",
        "hypot(" * n + name + ", 1)" * n,
    )
    return rng.choice(kinds)


def of_columns(columns: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """A table with other columns: odd numbers, times, lengths, kinds and names."""
    columns = dict(columns)
    for _ in range(rng.choice((1, 1, 2, 3))):
        name = rng.choice(list(columns))
        columns[name] = _odd_column(columns[name], rng)
        if rng.random() < 0.15:
            columns[rng.choice(ODD_TEXTS) or "p"] = columns.pop(name)
        if rng.random() < 0.1 and len(columns) > 1:
            columns.pop(rng.choice(list(columns)))
    kept = rng.choice((None, None, None, 0, 1, 2, 10, 100))
    return {name: column[:kept] for name, column in columns.items()}


def _odd_column(column: Any, rng: random.Random) -> Any:
    n, kind = len(column), rng.randrange(12)
    if column.dtype.kind not in "fiu" or not n:
        return column
    if kind == 11:
        return np.array([f"x{k}" for k in range(n)])
    if kind == 10:
        with np.errstate(all="ignore"):
            kinds = (np.int64, np.float32, np.uint8, np.bool_)
            return np.nan_to_num(column).astype(rng.choice(kinds))
    column = np.array(column, np.float64)
    some = slice(rng.randrange(n), None, rng.choice((1, 2, 7, n)))
    odd = rng.choice((np.nan, np.inf, -np.inf, 0.0, 1e308, -1e308, 1e-308, 1e20, 2.0**63))
    with np.errstate(all="ignore"):
        changed = (
            lambda c: c * 0.0 + odd,
            lambda c: c[::-1],
            lambda c: c * odd,
            lambda c: np.round(c, -2),
            lambda c: c + rng.choice((1e-9, 1.0, 1e9, 1e15)),
            lambda c: np.where(np.arange(len(c)) == len(c) // 2, odd, c),
            lambda c: -c,
        )
        if kind < len(changed):
            return changed[kind](column)
        column[some] = odd
    return column
