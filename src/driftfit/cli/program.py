"""The program: its name, where it prints, and how it reports errors.

A user's error prints one line on stderr and ends with exit code 2; a traceback is always a fault of the program.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer import Option
from typer.core import TyperGroup

from driftfit import __version__
from driftfit.show.axes import check_picture
from driftfit.show.text import WIDTH


@contextmanager
def helpful(program: str = "driftfit") -> Iterator[None]:
    """Turn errors that a user can correct into one line and exit code 2."""
    try:
        yield
    except (ValueError, OSError, ImportError) as error:
        typer.echo(f"{program}: {' '.join(_text(error).split())}", err=True)
        raise typer.Exit(2) from None


class Commands(TyperGroup):
    """All commands report errors of a user in the same way."""

    def invoke(self, ctx: Any) -> Any:
        with helpful():
            return super().invoke(ctx)


app = typer.Typer(
    cls=Commands, no_args_is_help=True, add_completion=False, rich_markup_mode=None,
    help="Track the parameters of a system while they change.",
)  # fmt: skip
progress = Console(stderr=True)


_screen = Console()
out = Console(width=min(WIDTH, _screen.width) if _screen.is_terminal else WIDTH, highlight=False, soft_wrap=False)
"""A console as wide as that of tables printed from Python, or as the terminal if that is narrower."""


def say(what: Any, **options: Any) -> None:
    """Print text unchanged: names of parameters contain brackets, and nothing is cut off."""
    out.print(what, markup=False, crop=False, **options)


def draw(path: Path | None, figure: Callable[[], Any]) -> None:
    """Save a picture, if one is wanted."""
    if path is not None:
        figure().savefig(path, dpi=150)


def main() -> None:
    """Run the installed program."""
    warnings.formatwarning = lambda message, *place: f"driftfit: warning: {message}\n"
    app()


def _text(error: Exception) -> str:
    """The message of an error; of one of the system, the file and what is wrong with it."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def writable(path: Path | None, option: str) -> None:
    """Check, before anything is computed, that a file can be written where an option says."""
    if path is None:
        return
    if not path.absolute().parent.is_dir():
        raise ValueError(f"{option} {path}: there is no folder {path.parent}.")
    if option in ("--plot", "--system"):
        check_picture(path)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"driftfit {__version__}")
        raise typer.Exit


@app.callback(help="Track the parameters of a system while they change.")
def _options(
    version: Annotated[
        bool, Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    pass
