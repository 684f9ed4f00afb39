"""Names from outside in generated text: identifiers and comments of C, and text in Markdown.

Names of signals and parameters may be any text; none of it may end a comment or a line, or be read as markup.
"""

from __future__ import annotations

import re

RESERVED = frozenset(
    """auto break case char const continue default do double else enum extern float for goto if int long register return
    short signed sizeof static struct switch typedef union unsigned void volatile while real inline restrict
    """.split()  # noqa: SIM905
)
"""Words that cannot be names of variables or functions in C."""


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


def literal(text: str) -> str:
    """A text in Markdown, none of which is markup."""
    return f"`{printed(text).replace('`', chr(39))}`"
