"""Results of several outputs, by the name of the output."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeVar

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.show.parts.text import Printed

Result = TypeVar("Result")


class ByOutput(Printed, Mapping[str, Result]):
    """What a verb found for each output of a record, by name; printing it shows one after the other."""

    def __init__(self, results: Mapping[str, Result]) -> None:
        self._results = dict(results)

    def __getitem__(self, output: str) -> Result:
        return self._results[output]

    def __iter__(self) -> Iterator[str]:
        return iter(self._results)

    def __len__(self) -> int:
        return len(self._results)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}: {one!r}' for name, one in self.items())})"

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for place, (name, one) in enumerate(self.items()):
            yield Text(f"\n{name}" if place else name, "bold")
            yield one if hasattr(one, "__rich_console__") else Text(repr(one))
