"""Terminal output of a command: text, JSON, progress; standard streams that are closed, full, or without reader."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from ltsim.cli.output_checks import RESULT_FOLDER_OUTPUT, ForceOption, check_overwrite
from ltsim.core.errors import as_printable

if TYPE_CHECKING:
    from ltsim.recordings.result_file import ResultFile

_STREAMS_CLOSED_AT_START: set[int] = set()
"""File descriptors (0 to 2) of the standard streams that were closed when the process started."""
_DISCARDED_STREAMS: set[int] = set()
"""File descriptors of the standard streams whose further output is discarded, because nothing can be written."""


def prepare_streams() -> None:
    """Preparation of the standard streams of this process for output.

    A closed stream is replaced by the null device, so that no other file takes its number. Characters that the encoding
    of a stream lacks are printed as escapes. Python warnings are shown only with `-W` or PYTHONWARNINGS.
    """
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _STREAMS_CLOSED_AT_START.add(descriptor)
            null_device = Path(os.devnull).open("r+", encoding="utf-8")  # noqa: SIM115  # takes the lowest free number
            os.set_inheritable(null_device.fileno(), True)
            setattr(sys, name, null_device)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        os.environ["PYTHONWARNINGS"] = "ignore"  # of worker processes


def is_output_closed() -> bool:
    """True if this process was started with a closed standard output."""
    return 1 in _STREAMS_CLOSED_AT_START


def is_reader_gone() -> bool:
    """True if the program that reads standard output through a pipe (such as `head`) has ended."""
    return 1 in _DISCARDED_STREAMS


def write_line(text: str, stream: IO[str]) -> None:
    """Output of a line of text with control characters escaped; raises OSError if standard output is not writable."""
    with _discard_if_unwritable(stream):
        print(as_printable(text), file=stream)


def flush_streams() -> None:
    """Flush of standard output and standard error; raises OSError if standard output cannot be written."""
    for stream in (sys.stdout, sys.stderr):
        with _discard_if_unwritable(stream):
            stream.flush()


@contextmanager
def _discard_if_unwritable(stream: IO[str]) -> Iterator[None]:
    """Context that redirects a stream to the null device if its reader is gone or standard error is unwritable.

    OSError is raised if standard output cannot be written for another reason.
    """
    try:
        yield
    except OSError as problem:
        if stream is not sys.stderr and not isinstance(problem, BrokenPipeError):
            raise
        discard_output(stream)


def discard_output(stream: IO[str]) -> None:
    """Redirection of a stream to the null device, so that a flush at the end of the program does not fail."""
    _DISCARDED_STREAMS.add(stream.fileno())
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, stream.fileno())
    os.close(null_device)


ResultFileType = TypeVar("ResultFileType", bound="ResultFile")
"""Class of the result that is written."""
FIRST_PROGRESS_DELAY_S = 10.0
"""Time [s] from the start of a task to its first printed line of progress, if standard error is not a terminal."""
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")]


@dataclass(frozen=True)
class Terminal:
    """Output of a command: text or JSON on standard output, notes and progress on standard error."""

    quiet: QuietOption = False
    """True if only errors are printed (`--quiet`)."""
    as_json: Annotated[bool, typer.Option("--json", help="Print only the result, as JSON.")] = False
    """True if only the result is printed, as JSON (`--json`)."""

    @property
    def is_silent(self) -> bool:
        """True if no text is printed, because of `--quiet` or `--json`."""
        return self.quiet or self.as_json

    def print_text(self, text: str = "") -> None:
        """Output of a line of text on standard output, except with `--quiet` or `--json`."""
        if not self.is_silent:
            write_line(text, sys.stdout)

    def print_always(self, text: str) -> None:
        """Output of a text that the user requested (a template, an address), also with `--quiet`."""
        write_line(text.removesuffix("\n"), sys.stdout)

    def print_unbuffered(self, text: str, *, rings_bell: bool = False) -> None:
        """Output of a line that appears at once, with a bell on a terminal if `rings_bell`."""
        if rings_bell and not self.is_silent and sys.stdout.isatty():
            print("\a", end="")
        self.print_text(text)
        flush_streams()

    def print_note(self, text: str) -> None:
        """Output of a note on standard error, except with `--quiet`."""
        if not self.quiet:
            write_line(text, sys.stderr)

    def print_note_on_compilation(self) -> None:
        """Output of a note that the campaign solver will be compiled first, if it is not compiled yet."""
        from ltsim.campaigns.kernels import has_cached_machine_code  # slow to import

        if not has_cached_machine_code():
            self.print_note("First campaign on this machine: compiling the solver takes about 10 s.")

    def print_notes(self, notes: Iterable[str]) -> None:
        """Output of notes on standard error, such as the interpretation of an ambiguous file."""
        for note in notes:
            self.print_note(f"note: {note}")

    def print_result(self, content: ResultFile, result_folder: Path | None = None, notes: Iterable[str] = ()) -> None:
        """Output of a result as JSON, or as the text of its section of the report page; then its notes and folder."""
        self.print_json(content.content())
        if not self.is_silent:
            from ltsim.reports.sections import result_section  # slow to import

            self.print_text("\n" + result_section(content).terminal_text())
        self.print_notes(notes)
        self.print_folder(result_folder)

    def print_folder(self, result_folder: Path | None) -> None:
        """Output of the path of the result folder, and of the command that makes a report page from it."""
        if result_folder is not None:
            self.print_text(f"\nwritten to {result_folder}; for a page with pictures: ltsim report {result_folder}")

    def print_json(self, content: Any) -> None:
        """Output of the result as JSON, if `--json` is given."""
        if self.as_json:
            write_line(json.dumps(content, indent=1, allow_nan=False), sys.stdout)

    def print_json_parts(self, parts: Iterable[str]) -> None:
        """Output of the parts of a long JSON text as they are made, if `--json` is given."""
        if self.as_json:
            with _discard_if_unwritable(sys.stdout):
                for part in parts:
                    print(as_printable(part), end="", file=sys.stdout)
                print(file=sys.stdout)

    @contextmanager
    def show_progress(self, task_text: str, n_steps: int | None = None) -> Iterator[Callable[[int], None]]:
        """Progress bar on a terminal, or occasional lines in a pipe; yields a function that counts finished steps.

        `n_steps` is the number of steps; None if it is unknown.
        """
        if self.quiet or not sys.stderr.isatty():
            n_done_steps = [0]
            with self._print_progress_lines(
                lambda: task_text if n_steps is None else f"{task_text}: {n_done_steps[0]} of {n_steps}"
            ):
                yield lambda steps: n_done_steps.__setitem__(0, n_done_steps[0] + steps)
            return
        from rich.console import Console  # imported here: a twentieth of a second that few commands need
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        count_columns = () if n_steps is None else (MofNCompleteColumn(), TimeRemainingColumn())
        columns = (TextColumn("{task.description}"), BarColumn(), *count_columns)
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress_bar:
            task = progress_bar.add_task(task_text, total=n_steps)
            yield lambda steps: progress_bar.advance(task, steps)

    @contextmanager
    def _print_progress_lines(self, get_progress_text: Callable[[], str]) -> Iterator[None]:
        """Lines of progress on standard error, the first after `FIRST_PROGRESS_DELAY_S`, then in doubling intervals."""
        if self.quiet:
            yield
            return
        start_time, is_finished = time.monotonic(), threading.Event()

        def print_lines() -> None:
            wait_s = FIRST_PROGRESS_DELAY_S
            while not is_finished.wait(wait_s):
                wait_s = time.monotonic() - start_time
                self.print_note(f"{get_progress_text()} ({wait_s:.0f} s)")
                flush_streams()

        thread = threading.Thread(target=print_lines, daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_finished.set()
            thread.join()


@dataclass(frozen=True)
class ResultFolderTerminal(Terminal):
    """Terminal of a command with options `--out` and `--force`, which writes its result to a folder."""

    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder to write the results to."),
        RESULT_FOLDER_OUTPUT,
    ] = None
    """Folder to which the result is written; None if no folder was given."""
    force: ForceOption = False
    """True if existing files may be replaced (`--force`)."""

    def check_overwrite(
        self,
        model: type[ResultFile],
        is_of_same_command: Callable[[Any], bool] = lambda result: True,
    ) -> None:
        """Check that a result and its companion files would replace only older results of the same command.

        `model` is the class of the result. If several commands write the same kind of file, `is_of_same_command`
        returns True for an existing result of this command. Raises RecordError.
        """
        check_overwrite(self.out, model, force=self.force, is_of_same_command=is_of_same_command)

    def write_result(
        self, content: ResultFileType, further_files: Callable[[], Mapping[str, str | bytes]] = dict
    ) -> ResultFileType:
        """Result that contains the digests of its companion files, after all were written to the folder of `--out`.

        Without a folder it is the given result. `further_files` returns the contents, by name, of the files other than
        the tables of the result.
        """
        from ltsim.recordings.result_file import write_result

        return content if self.out is None else write_result(self.out, content, further_files())

    def print_result(self, content: ResultFile, result_folder: Path | None = None, notes: Iterable[str] = ()) -> None:
        """Output of a result, and of the folder to which it was written."""
        super().print_result(content, result_folder or self.out, notes)
