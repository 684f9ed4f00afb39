"""Reproductions of papers. A module in this folder with a function `main` is ``python -m lab reproduce NAME``."""

from __future__ import annotations

from pkgutil import iter_modules


def found() -> list[str]:
    """Their names on the command line."""
    return sorted(module.name.replace("_", "-") for module in iter_modules(__path__))
