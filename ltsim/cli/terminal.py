"""Terminal output of a command: text, JSON and progress."""

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

from ltsim.cli import streams
from ltsim.cli.places import FOLDER, Force, check_overwrite

if TYPE_CHECKING:
    from ltsim.recordings.result_file import ResultFile

File = TypeVar("File", bound="ResultFile")
PROGRESS_DELAY = 10.0
"""Time [s] after which a pipe receives a line of progress."""
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")]


@dataclass(frozen=True)
class Terminal:
    """Terminal output of one command."""

    quiet: Quiet = False
    as_json: Annotated[bool, typer.Option("--json", help="Print only the answer, as JSON.")] = False

    @property
    def silent(self) -> bool:
        """True if text is not printed."""
        return self.quiet or self.as_json

    def say(self, text: str = "") -> None:
        """Output of a line of text, unless silent."""
        if not self.silent:
            streams.write(text, sys.stdout)

    def show(self, text: str) -> None:
        """Output that is printed even if silent: a file to edit, an address."""
        streams.write(text.removesuffix("\n"), sys.stdout)

    def print_now(self, text: str, *, bell: bool = False) -> None:
        """Unbuffered output of a line, optionally with a bell on a terminal."""
        if bell and not self.silent and sys.stdout.isatty():
            print("\a", end="")
        self.say(text)
        streams.flush()

    def note(self, text: str) -> None:
        """Output of a remark on standard error."""
        if not self.quiet:
            streams.write(text, sys.stderr)

    def notes(self, notes: Iterable[str]) -> None:
        """Output of notes on standard error: interpretations of ambiguous input, and missing data."""
        for note in notes:
            self.note(f"note: {note}")

    def result(self, content: ResultFile, out: Path | None = None, notes: Iterable[str] = ()) -> None:
        """Output of a result: as JSON, or as the text of its section of the page without figures."""
        self.answer(content.content())
        if not self.silent:
            from ltsim.reports.sections import section_of  # slow to import

            self.say("\n" + section_of(content).text())
        self.notes(notes)
        self.written(out)

    def written(self, out: Path | None) -> None:
        """Output of the result folder and of the command that displays it."""
        if out is not None:
            self.say(f"\nwritten to {out}; for a page with pictures: ltsim report {out}")

    def answer(self, content: Any) -> None:
        """Output of the result as JSON, if requested."""
        if self.as_json:
            streams.write(json.dumps(content, indent=1, allow_nan=False), sys.stdout)

    @contextmanager
    def progress(self, what: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
        """Progress bar on standard error, or occasional lines in a pipe; yields a function that counts steps."""
        if self.quiet or not sys.stderr.isatty():
            done = [0]
            with self._sign_of_life(lambda: what if total is None else f"{what}: {done[0]} of {total}"):
                yield lambda steps: done.__setitem__(0, done[0] + steps)
            return
        from rich.console import Console  # imported here: a twentieth of a second that few commands need
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        counted = () if total is None else (MofNCompleteColumn(), TimeRemainingColumn())
        columns = (TextColumn("{task.description}"), BarColumn(), *counted)
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(what, total=total)
            yield lambda steps: bar.advance(task, steps)

    @contextmanager
    def _sign_of_life(self, words: Callable[[], str]) -> Iterator[None]:
        """Lines of progress on standard error, after `PROGRESS_DELAY` seconds and whenever the time has doubled."""
        if self.quiet:
            yield
            return
        began, done = time.monotonic(), threading.Event()

        def tell() -> None:
            wait = PROGRESS_DELAY
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
    """Terminal of a command that writes its results to a folder."""

    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write the results to."), FOLDER
    ] = None
    force: Force = False

    def check_overwrite(
        self, model: type[ResultFile], *names: str, same_verb: Callable[[Any], bool] = lambda result: True
    ) -> None:
        """Check that a result and its companion files would not replace other files; raises RecordError."""
        check_overwrite(self.out, model, names, force=self.force, same_verb=same_verb)

    def write(self, content: File, companions: Callable[[], Mapping[str, str | bytes]] = dict) -> File:
        """Result as written with its companion files, if there is a folder; otherwise the result itself."""
        from ltsim.recordings.result_file import write_result

        return content if self.out is None else write_result(self.out, content, companions())

    def result(self, content: ResultFile, out: Path | None = None, notes: Iterable[str] = ()) -> None:
        """Output of a result and of the folder to which it was written."""
        super().result(content, out or self.out, notes)
