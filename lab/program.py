"""The command line of the laboratory: ``python -m lab bench``, ``bounds``, ``reproduce``, ``same-numbers``, .."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated

import typer
from rich.console import Console

from driftfit.cli.program import helpful
from driftfit.engine.settings import near
from lab import budgets, faults, pages, same_numbers, structure
from lab.bench import commands as bench
from lab.bounds.commands import bounds
from lab.reproduce import found as reproductions

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    help="What shows that the library is right and fast; run from a checkout.",
)
app.add_typer(bench.app, name="bench", help="Compare accuracy and speed with other packages.")
app.add_typer(
    same_numbers.app, name="same-numbers", help="Compare random configurations bit for bit, before and after."
)
app.command(name="structure")(structure.show)
app.command(name="budgets")(budgets.show)
app.command(name="faults")(faults.show)
app.command(name="pages")(pages.show)
app.command(name="bounds")(bounds)
out = Console(highlight=False)


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []},
    help=f"Reproduce a paper: {', '.join(reproductions())}. Options: python -m lab reproduce NAME --help.",
)
def reproduce(context: typer.Context, name: Annotated[str, typer.Argument(help="Which one.")] = "--help") -> None:
    """Run one of the reproductions with its own options."""
    if name == "--help":
        out.print(f"python -m lab reproduce {{{','.join(reproductions())}}} [--help]", markup=False)
        return
    with helpful("lab"):
        if name not in reproductions():
            raise ValueError(f"there is no reproduction {name!r}; {near(name, reproductions())}")
        program = typer.Typer(add_completion=False, rich_markup_mode=None)
        program.command()(import_module(f"lab.reproduce.{name.replace('-', '_')}").main)
        program(args=context.args, prog_name=f"python -m lab reproduce {name}", standalone_mode=False)
