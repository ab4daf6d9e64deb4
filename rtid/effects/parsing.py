"""From text to the tree of an expression: a whitelist over Python's own grammar, nothing is run.

Python's `ast` only reads the text.  Numbers, known names, + - * / **, signs, brackets and calls of
the functions of `rtid.effects.tree` become a tree; everything else is refused with its place.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Collection
from typing import NoReturn

from rtid.effects.tree import FUNCTIONS, NAME, NEG, NUMBER, Node
from rtid.errors import RtidError
from rtid.units import nearest

MOST_CHARACTERS = 1000
MOST_DEPTH = 100
MOST_POWER = 8.0
CONSTANTS = {"pi": math.pi}
_BINARY: dict[type[ast.operator], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.Pow: "**",
}
_ALLOWED = "numbers, names, + - * / **, brackets and " + ", ".join(FUNCTIONS)


class ExpressionError(RtidError):
    """An expression that cannot be used: `reason`, and `column` (from 0) of the place in `text`."""

    exit_code = 2

    def __init__(self, text: str, column: int, reason: str, remedy: str) -> None:
        self.text, self.column, self.reason = text, column, reason
        super().__init__(f"{reason}\n  {text}\n  {' ' * column}^", remedy)

    @property
    def in_one_line(self) -> str:
        """Reason and place without the caret."""
        shown = self.text if len(self.text) <= 60 else self.text[:57] + "..."
        return f"{self.reason} (column {self.column + 1} of {shown!r})"


def parse(text: str, names: Collection[str] | None) -> tuple[str, Node]:
    """The text in one line and its tree; None allows any name.  ExpressionError says why not."""
    text = _one_line(text)
    return text, _Reader(text, names).node(_python_tree(text))


def _one_line(text: str) -> str:
    if len(text) > MOST_CHARACTERS:
        reason = f"the expression is longer than {MOST_CHARACTERS} characters"
        raise ExpressionError(text[:60] + "...", 0, reason, "split it into several effects")
    text = "".join(" " if c in "\r\n\t" else c for c in text).strip()
    if not text:
        raise ExpressionError("", 0, "the expression is empty", 'write e.g. "p_a - p_b"')
    for column, c in enumerate(text):
        if c == "#" or not c.isascii() or not c.isprintable():
            raise ExpressionError(text, column, f"{c!r} cannot be used here", f"use {_ALLOWED}")
    return text


def _python_tree(text: str) -> ast.expr:
    try:
        with warnings.catch_warnings(action="ignore"):  # Python's doubts about a style, e.g. 1if
            tree = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        column = min(max((error.offset or 1) - 1, 0), len(text))
        reason = f"not an expression: {error.msg}"
        raise ExpressionError(text, column, reason, f"use {_ALLOWED}") from None
    except (MemoryError, RecursionError, ValueError):
        raise ExpressionError(text, 0, "the expression is nested too deeply", "simplify") from None
    _refuse_depth(text, tree)
    return tree


def _refuse_depth(text: str, tree: ast.expr) -> None:
    level: list[ast.AST] = [tree]
    for _ in range(MOST_DEPTH):
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        if not level:
            return
    reason = f"the expression is nested more than {MOST_DEPTH} deep"
    raise ExpressionError(text, 0, reason, "simplify it, or use brackets to balance a long sum")


class _Reader:
    """Turns Python's nodes into ours, refusing what is not on the list."""

    def __init__(self, text: str, names: Collection[str] | None) -> None:
        self.text, self.names = text, names

    def refuse(self, at: ast.expr, reason: str, remedy: str) -> NoReturn:
        raise ExpressionError(self.text, at.col_offset, reason, remedy)

    def node(self, found: ast.expr) -> Node:
        if isinstance(found, ast.Constant):
            return self._number(found)
        if isinstance(found, ast.Name):
            return self._name(found)
        if isinstance(found, ast.UnaryOp):
            return self._signed(found)
        if isinstance(found, ast.BinOp):
            return self._operator(found)
        if isinstance(found, ast.Call):
            return self._call(found)
        what = type(found).__name__
        self.refuse(found, f"{what} is not allowed in an expression", f"use {_ALLOWED}")

    def _number(self, found: ast.Constant) -> Node:
        value = found.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.refuse(found, f"{value!r} is not a number", "write a plain number")
        try:
            size = float(value)
        except OverflowError:
            size = math.inf
        if math.isinf(size):
            self.refuse(found, "the number is too large", "write it as e.g. 1.5e6")
        return Node(NUMBER, value=size, column=found.col_offset)

    def _name(self, found: ast.Name) -> Node:
        name = found.id
        if self.names is None or name in self.names:
            return Node(NAME, name=name, column=found.col_offset)
        if name in CONSTANTS:
            return Node(NUMBER, value=CONSTANTS[name], column=found.col_offset)
        if name in FUNCTIONS:
            self.refuse(found, f"{name!r} is a function", f"write {name}(...)")
        self.refuse(found, f"{name!r} is no known name", nearest(name, list(self.names)))

    def _signed(self, found: ast.UnaryOp) -> Node:
        if isinstance(found.op, ast.UAdd):
            return self.node(found.operand)
        if isinstance(found.op, ast.USub):
            return Node(NEG, (self.node(found.operand),), column=found.col_offset)
        self.refuse(found, "only + and - may stand before a value", f"use {_ALLOWED}")

    def _operator(self, found: ast.BinOp) -> Node:
        op = _BINARY.get(type(found.op))
        if op is None:
            what = type(found.op).__name__
            self.refuse(found, f"the operator {what} is not allowed", f"use {_ALLOWED}")
        left, right = self.node(found.left), self.node(found.right)
        if op == "**":
            self._limit_power(found.right, right)
        return Node(op, (left, right), column=found.col_offset)

    def _limit_power(self, found: ast.expr, power: Node) -> None:
        size = power.args[0] if power.op == NEG else power
        if size.op == NUMBER and size.value > MOST_POWER:
            reason = f"a power beyond {MOST_POWER:g} is not allowed"
            self.refuse(found, reason, "use exp, or a smaller power")

    def _call(self, found: ast.Call) -> Node:
        if not isinstance(found.func, ast.Name):
            self.refuse(found, "only a function by its name can be called", f"use {_ALLOWED}")
        name = found.func.id
        if name not in FUNCTIONS:
            near = nearest(name, list(FUNCTIONS))
            self.refuse(found, f"{name!r} is no known function", near)
        if found.keywords or any(isinstance(arg, ast.Starred) for arg in found.args):
            self.refuse(found, f"{name} takes plain arguments only", f"write {name}(z)")
        return self._applied(found, name)

    def _applied(self, found: ast.Call, name: str) -> Node:
        """The call with its number of arguments checked; min and max take two or more."""
        wanted = FUNCTIONS[name][0]
        least_or_exact = len(found.args) == wanted
        if name in ("min", "max"):
            least_or_exact = len(found.args) >= wanted
        if not least_or_exact:
            reason = f"{name} takes {wanted} argument{'s' * (wanted > 1)}, not {len(found.args)}"
            self.refuse(found, reason, "count the commas")
        args = [self.node(arg) for arg in found.args]
        node = Node(name, tuple(args[:wanted]), column=found.col_offset)
        for more in args[wanted:]:
            node = Node(name, (node, more), column=found.col_offset)
        return node
