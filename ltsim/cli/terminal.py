"""What a verb says: lines for a person, JSON for a program, progress only where somebody watches."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ltsim.errors import ModelError


@dataclass(frozen=True)
class Terminal:
    """Where a verb prints; `quiet` and `as_json` are the verb's options."""

    quiet: bool = False
    as_json: bool = False

    def say(self, text: str = "") -> None:
        """A line for a person."""
        if not self.quiet and not self.as_json:
            print(text)

    def note(self, text: str) -> None:
        """A remark that does not belong to the answer: on standard error."""
        if not self.quiet:
            print(text, file=sys.stderr)

    def answer(self, content: Any) -> None:
        """The whole answer for a program, where it asked for it."""
        if self.as_json:
            print(json.dumps(content, indent=1, allow_nan=False))

    @contextmanager
    def progress(self, what: str, total: int) -> Iterator[Callable[[int], None]]:
        """A bar on standard error, on a terminal only; the function it gives counts steps done."""
        if self.quiet or not sys.stderr.isatty():
            yield lambda steps: None
            return
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(what, total=total)
            yield lambda steps: bar.advance(task, steps)

    @contextmanager
    def busy(self, what: str) -> Iterator[None]:
        """A sign of life on a terminal while something takes its time."""
        if self.quiet or not sys.stderr.isatty():
            yield
            return
        with Console(stderr=True).status(what):
            yield


def table(header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Rows as aligned text, the first `left` columns to the left, numbers to the right.

    Raises
    ------
    ModelError
        When a row is not as long as the header.
    """
    if any(len(row) != len(header) for row in rows):
        raise ModelError("a row of a table is not as long as its header")
    lines = [header, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def digits(value: float, sigma: float) -> tuple[str, str]:
    """A value and its sigma with two digits of the sigma."""
    if not sigma > 0:
        return f"{value:.4g}", "0"
    decimals = 0
    while sigma * 10**decimals < 9.5 and decimals < 9:
        decimals += 1
    return f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"
