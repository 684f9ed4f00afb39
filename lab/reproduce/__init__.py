"""Reproductions of papers. A folder in this one with a function `main` is ``python -m lab reproduce NAME``.

A `Claim` of a paper is judged by a function of numbers, with a rule that is printed next to its verdict.
"""

from __future__ import annotations

from pkgutil import iter_modules
from textwrap import fill, indent
from typing import NamedTuple


class Claim(NamedTuple):
    """A claim, its verdict, the rule of the verdict, and the numbers to which the rule was applied."""

    claim: str
    verdict: str
    rule: str
    measured: str

    def text(self, width: int, by: str) -> str:
        """Numbers and rule, indented."""
        return "\n".join(indent(fill(text, width), by) for text in (self.measured, f"Rule: {self.rule}"))


def bound(x: float) -> str:
    """What an error is at most, to one digit: those of rounding differ between processors."""
    return f"{max(x, 1e-9):.0e}"


def found() -> list[str]:
    """Their names on the command line."""
    return sorted(module.name.replace("_", "-") for module in iter_modules(__path__))
