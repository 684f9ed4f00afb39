"""The translator's view of an expression: its text in C, its kind, and its value if it is a constant.

real    a floating-point number: double, or float if the source is compiled for it
int     an integer from a loop or a constant; long, a 64-bit integer from the record; bool, a truth value
flag    a floating-point number that is 0 or 1, which C keeps as an int: comparing doubles in software is slow
record  the state; tile, an array of one state
array   numbers in memory: their start, their shape, and the stride of every axis
address the address of the first number of an array
items   several values, such as the addresses that a routine is given together
table   a tuple or an array of constants; python, a function or module; nothing, no value
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array

RANK = ("bool", "flag", "int", "long", "real")
"""Kinds of numbers, from narrow to wide."""

BIGGEST_SINGLE, SMALLEST_SINGLE = 1e18, 1e-30
"""Constants beyond these are replaced by them in single precision, where their squares would overflow or vanish."""


@dataclass(frozen=True)
class Value:
    """One expression."""

    kind: str
    text: str = ""
    constant: Any = None
    shape: tuple[int, ...] = ()
    strides: tuple[int, ...] = ()
    element: str = "real"
    scalar: bool = False
    most: int | None = None
    """The largest value of an integer if it is known: an upper bound of a loop."""

    @property
    def known(self) -> bool:
        return self.constant is not None

    def key(self) -> tuple[Any, ...]:
        """The key of specialisation: constant integers are part of it, constant floats are not."""
        fixed = self.constant if self.kind in ("bool", "int", "table", "python") else None
        fixed = id(fixed) if self.kind in ("table", "python") else fixed
        fixed = len(self.constant) if self.kind == "items" else fixed
        return self.kind, fixed, self.shape, self.strides, self.element, self.scalar


def number(value: Any) -> Value:
    if isinstance(value, bool | np.bool_):
        return Value("bool", "1" if value else "0", bool(value))
    if isinstance(value, int | np.integer):
        kind = "int" if abs(int(value)) < 2**31 else "long"
        return Value(kind, str(int(value)) + ("" if kind == "int" else "LL"), int(value), most=int(value))
    return Value("real", literal(float(value)), float(value))


def literal(x: float) -> str:
    """A floating-point constant with all its bits, and its replacement in single precision."""
    if np.isnan(x):
        return "NAN"
    if np.isinf(x):
        return "INFINITY" if x > 0.0 else "(-INFINITY)"
    size = abs(x)
    single = size if size == 0.0 else min(max(size, SMALLEST_SINGLE), BIGGEST_SINGLE)
    if single == size:
        return f"R({x!r})"
    return f"WIDE({x!r}, {float(np.copysign(single, x))!r}f)"


def joined(*kinds: str) -> str:
    """The kind of number that can represent all of these."""
    widest = max(kinds, key=RANK.index)
    return "real" if "flag" in kinds and widest in ("int", "long") else widest


def narrow(value: Value) -> str:
    """The kind of a value, with constants that are a floating-point 0 or 1 among the flags."""
    unit = value.kind == "real" and value.known and (value.constant == 1.0 or literal(value.constant) == "R(0.0)")
    return "flag" if unit else value.kind


def plain(value: Value) -> Value:
    """A flag as the floating-point number that it is; other values unchanged."""
    return Value("real", f"({value.text} ? R(1.0) : R(0.0))") if value.kind == "flag" else value


def assigned(value: Value, kind: str) -> str:
    """The text of a value that is assigned to something of this kind."""
    if kind == "flag" and narrow(value) == "flag":
        return str(int(value.constant)) if value.known else value.text
    return plain(value).text


def lifted(value: Any) -> Value:
    """A Python object that a step uses."""
    if isinstance(value, bool | int | float | np.generic):
        return number(value)
    if isinstance(value, tuple | np.ndarray):
        return Value("table", constant=value)
    return Value("python", constant=value)


def strides_of(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(int(np.prod(shape[axis + 1 :])) for axis in range(len(shape)))


def view(array: Value, index: Sequence[Value | range]) -> Value:
    """Part of an array, or one number of it; a range selects part of an axis."""
    offset: list[str] = []
    shape, strides = [], []
    for axis, one in enumerate(index):
        stride = array.strides[axis]
        if isinstance(one, range):
            shape.append(len(one))
            strides.append(stride)
            if one.start:
                offset.append(str(one.start * stride))
        elif one.constant != 0:
            offset.append(one.text if stride == 1 else f"{one.text} * {stride}")
    at = " + ".join(f"({one})" if " * " in one and len(offset) > 1 else one for one in offset)
    if shape:
        begin = f"({begin_of(array)} + {at})" if at else begin_of(array)
        return Value("array", begin, shape=tuple(shape), strides=tuple(strides), element=array.element)
    text = array.text if array.scalar else f"{array.text}[{bare(at) or '0'}]"
    return Value(array.element, text)


def begin_of(array: Value) -> str:
    """The address of an array's first number."""
    return f"&{array.text}" if array.scalar else array.text


def renamed(value: Value, text: str) -> Value:
    """The same value under the name of a parameter; a scalar of the record is one number behind an address."""
    return replace(value, text=text, scalar=False)


def bare(text: str) -> str:
    """An expression without outer brackets."""
    depth = 0
    if not (text.startswith("(") and text.endswith(")")):
        return text
    for i, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and i < len(text) - 1:
            return text
    return text[1:-1]


RESERVED = frozenset(
    """auto break case char const continue default do double else enum extern float for goto if int long register return
    scratch short signed sizeof static struct switch typedef union unsigned void volatile while real inline restrict
    """.split()  # noqa: SIM905
)
"""Words that cannot be names of variables or functions in C.

Names of signals and parameters may be any text; none of it may end a comment or a line, or be read as markup.
"""


def identifier(name: str) -> str:
    """A name that is valid in C: letters beyond ASCII are written as their numbers."""
    plain = "".join(one if one.isascii() else f"_u{ord(one):04x}" for one in name)
    return f"{plain}_" if plain in RESERVED else plain


def printed(text: str) -> str:
    """A text on one line; signs that are not printed, such as those that turn the direction, as their numbers."""
    return "".join(one if one.isprintable() else f"\\u{ord(one):04x}" for one in text)


def comment(text: str) -> str:
    """A text within a comment of C, which it neither ends nor begins."""
    return re.sub(r"\*(?=/)|/(?=\*)", r"\g<0> ", printed(text))


def as_code(text: str) -> str:
    """A text in Markdown, none of which is markup."""
    return f"`{printed(text).replace('`', chr(39))}`"


TYPES = {"real": "real", "int": "int", "long": "int64_t", "bool": "int", "flag": "int"}
"""C types of the kinds of numbers."""


class TranslationError(ValueError):
    """A step uses something that has no translation."""


@dataclass(frozen=True)
class Function:
    """One function in C: its text, the kinds of its results, and an upper bound of its operations."""

    name: str
    returns: tuple[str, ...]
    text: str
    operations: Counter[str]


class Unit:
    """The shared state of the functions of one file."""

    def __init__(
        self, record: Array, constant: frozenset[str], flags: frozenset[str], scratch: frozenset[str],
        ordinary: bool = False,
    ) -> None:  # fmt: skip
        self.record, self.scratch = record, scratch
        self.ordinary = ordinary
        """Whether only the operations of an ordinary sample are counted."""
        self.constant = constant
        """Fields that are assumed to keep the values that they start with."""
        self.flags = flags
        """Fields of one number that is assumed to be 0 or 1 at all times."""
        self.beyond: set[str] = set()
        """Fields that a translated function may set to other numbers than 0 and 1."""
        self.written: set[str] = set()
        """Fields that a translated function may write."""
        self.replaced: set[str] = set()
        """Fields that are replaced by their value in the text."""
        self.functions: dict[Any, Function] = {}
        self.tables: dict[str, str] = {}
        self.names: Counter[str] = Counter()
        self.largest = max((size for name in record.dtype.names or () for size in record[name].shape), default=1)
        """The largest extent in the record: the upper bound of loops about which nothing else is known."""

    def field(self, name: str) -> Value:
        """A field of the record, whose last axis is the only lane; a table if it keeps different numbers."""
        array, owner = self.record[name][0], "scratch" if name in self.scratch else "s"
        element = "long" if array.dtype.kind == "i" else "flag" if name in self.flags else "real"
        text = f"{owner}->{identifier(name)}"
        if name in self.constant and element == "real" and self.start_of(name) is None:
            self.replaced.add(name)
            text, _ = self.table(array)
        return Value("array", text, shape=array.shape, strides=strides_of(array.shape), element=element,
                     scalar=array.size == 1)  # fmt: skip

    def start_of(self, name: str) -> Any:
        """The value that every entry of a constant field has; None if there is no such value."""
        values = self.record[name][0].ravel()
        if name not in self.constant or len(np.unique(values.view(np.int64))) != 1:  # 0.0 is not -0.0
            return None
        self.replaced.add(name)
        return values[0].item()

    def table(self, values: Any) -> tuple[str, str]:
        """(name, kind) of a table of constants."""
        flat = [lifted(one) for one in np.ravel(values).tolist()]
        kind = joined(*(one.kind for one in flat))
        text = ", ".join(one.text for one in flat)
        body = f"static const {TYPES[kind]} %s[{len(flat)}] = {{{text}}};"
        return self.tables.setdefault(body, f"table_{len(self.tables) + 1}"), kind
