"""The structure of `.mat` files, version 5: checked before scipy reads them, because it crashes on damaged ones.

A file is a header of 128 bytes and elements: a type, a number of bytes, and so many bytes. A variable is an element
MATRIX, perhaps compressed, which consists of elements: flags with its class, dimensions, name, and what the class has.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator

import numpy as np

from driftfit.data.files import check_unpacked

INT32, UINT32, MATRIX, COMPRESSED = 5, 6, 14, 15
WIDTHS = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
"""Bytes of a number, by type."""
TEXTS = (1, 2, 3, 4, 16, 17, 18)
"""Types of characters."""
CELL, STRUCT, CHAR, NUMBERS = 1, 2, 4, range(6, 16)
"""Classes; others are objects, functions and sparse matrices."""
COMPLEX = 0x08


def readable(data: bytes, where: str) -> dict[str, bool]:
    """By variable of a file: whether it consists of numbers, texts, cells and structs; ValueError if it is damaged."""
    order = "<" if data[126:128] == b"IM" else ">"
    found, unpacked = {}, 0
    for kind, body in _elements(data[128:], order):
        if kind == COMPRESSED:
            inflate = zlib.decompressobj()
            head = inflate.decompress(body, 8)
            size = int.from_bytes(head[4:], "little" if order == "<" else "big")
            check_unpacked(where, len(data), unpacked := unpacked + size)
            ((kind, body),) = _elements(head + inflate.decompress(inflate.unconsumed_tail, size + 1), order)
        if kind != MATRIX:
            raise ValueError(f"an element of type {kind} is no variable")
        name, fine = _matrix(body, order)
        found[name] = fine
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """(type, contents)."""
    at = 0
    while at < len(data):
        kind, size = (int(one) for one in np.frombuffer(data, f"{order}u4", 2, at))
        small = kind >> 16
        begin = at + 4 if small else at + 8
        kind, size = (kind & 0xFFFF, small) if small else (kind, size)
        if begin + size > len(data) or small > 4:
            raise ValueError(f"an element of {size} bytes goes beyond the end")
        yield kind, data[begin : begin + size]
        at = at + 8 if small else begin + size + (0 if kind == COMPRESSED else -size % 8)


def _matrix(data: bytes, order: str) -> tuple[str, bool]:
    """(name, whether it consists of what is read here); ValueError if its parts do not fit together."""
    if not data:
        return "", True
    (a, flags), (b, dimensions), (c, name), *parts = _elements(data, order)
    if (a, b, c, len(flags)) != (UINT32, INT32, 1, 8) or len(dimensions) % 4 or len(dimensions) < 8:
        raise ValueError("a variable without class, dimensions or name")
    about, shape = int(np.frombuffer(flags, f"{order}u4")[0]), np.frombuffer(dimensions, f"{order}i4").tolist()
    kind, count, text = about & 0xFF, math.prod(shape), name.decode("latin1")
    if kind in NUMBERS:
        fine = len(parts) == 1 + bool(about >> 8 & COMPLEX)
        fine &= all(one in WIDTHS and WIDTHS[one] * count == len(body) for one, body in parts)
    elif kind == CHAR:
        fine = len(parts) == 1 and parts[0][0] in TEXTS and count <= len(parts[0][1])
    elif kind in (CELL, STRUCT):
        fine = count <= len(data)
    else:
        return text, False
    if not fine or min(shape) < 0:
        raise ValueError(f"the variable {text!r} has other contents than its class and dimensions say")
    return text, all([_matrix(body, order)[1] for one, body in parts if one == MATRIX])
