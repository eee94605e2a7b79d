"""Output of a verb: lines for a person, JSON for a program, progress only where somebody watches."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ltsim.cli import streams
from ltsim.cli.places import FOLDER, Force, claim

if TYPE_CHECKING:
    from ltsim.recordings.result_file import ResultFile

File = TypeVar("File", bound="ResultFile")
SILENCE = 10.0
"""[s] after which a pipe receives a sign that the work goes on."""
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]


@dataclass(frozen=True)
class Terminal:
    """Output of one verb."""

    quiet: Quiet = False
    as_json: Annotated[bool, typer.Option("--json", help="Print the answer as JSON, and nothing else.")] = False

    @property
    def silent(self) -> bool:
        """True where no line for a person is printed."""
        return self.quiet or self.as_json

    def say(self, text: str = "") -> None:
        """A line for a person."""
        if not self.silent:
            streams.write(text, sys.stdout)

    def show(self, text: str) -> None:
        """Output that was asked for, whatever else is to be silent: a file to edit, an address."""
        streams.write(text.removesuffix("\n"), sys.stdout)

    def at_once(self, text: str, *, bell: bool = False) -> None:
        """A line that somebody waits for: held in no buffer, with a bell where somebody watches."""
        if bell and not self.silent and sys.stdout.isatty():
            print("\a", end="")
        self.say(text)
        streams.flush()

    def note(self, text: str) -> None:
        """A remark that does not belong to the answer: on standard error."""
        if not self.quiet:
            streams.write(text, sys.stderr)

    def notes(self, notes: Iterable[str]) -> None:
        """Notes on standard error: decisions of the reader where the input leaves a choice, and missing data."""
        for note in notes:
            self.note(f"note: {note}")

    def result(self, content: ResultFile, out: Path | None = None, notes: Iterable[str] = ()) -> None:
        """A result that a page tells of: all of it for a program, for a person what the page says without pictures."""
        self.answer(content.content())
        if not self.silent:
            from ltsim.reports.sections import section_of  # what a page needs takes its time to load

            self.say("\n" + section_of(content).text())
        self.notes(notes)
        self.written(out)

    def written(self, out: Path | None) -> None:
        """Line with the folder of the results and the command that shows them."""
        if out is not None:
            self.say(f"\nwritten to {out}; for a page with pictures: ltsim report {out}")

    def answer(self, content: Any) -> None:
        """The whole answer for a program, where it asked for it."""
        if self.as_json:
            streams.write(json.dumps(content, indent=1, allow_nan=False), sys.stdout)

    @contextmanager
    def progress(self, what: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
        """A bar on standard error, in a pipe a line now and then; the function it gives counts steps done."""
        if self.quiet or not sys.stderr.isatty():
            done = [0]
            with self._sign_of_life(lambda: what if total is None else f"{what}: {done[0]} of {total}"):
                yield lambda steps: done.__setitem__(0, done[0] + steps)
            return
        counted = () if total is None else (MofNCompleteColumn(), TimeRemainingColumn())
        columns = (TextColumn("{task.description}"), BarColumn(), *counted)
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(what, total=total)
            yield lambda steps: bar.advance(task, steps)

    @contextmanager
    def _sign_of_life(self, words: Callable[[], str]) -> Iterator[None]:
        """A line on standard error after `SILENCE` seconds, and whenever the time has doubled."""
        if self.quiet:
            yield
            return
        began, done = time.monotonic(), threading.Event()

        def tell() -> None:
            wait = SILENCE
            while not done.wait(wait):
                wait = time.monotonic() - began
                self.note(f"{words()} ({wait:.0f} s)")
                streams.flush()

        thread = threading.Thread(target=tell, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


@dataclass(frozen=True)
class ResultTerminal(Terminal):
    """A terminal, and the folder that a verb writes to what it finds."""

    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write the results to."), FOLDER
    ] = None
    force: Force = False

    def claim(self, model: type[ResultFile], *names: str, own: Callable[[Any], bool] = lambda found: True) -> None:
        """Make sure that a result and the files beside it replace nothing else; raises RecordError."""
        claim(self.out, model, names, force=self.force, own=own)

    def kept(self, content: File, beside: Callable[[], Mapping[str, str | bytes]] = dict) -> File:
        """A result, written with the files beside it where there is a folder for them."""
        from ltsim.recordings.result_file import write_result

        return content if self.out is None else write_result(self.out, content, beside())

    def result(self, content: ResultFile, out: Path | None = None, notes: Iterable[str] = ()) -> None:
        """The same, and where it was written."""
        super().result(content, out or self.out, notes)
