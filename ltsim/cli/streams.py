"""Standard output and error streams that may be closed, full, without reader, or in any encoding."""

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ltsim.core.errors import printable

_CLOSED: set[int] = set()
_DROPPED: set[int] = set()


def prepare() -> None:
    """Preparation of the standard streams of this process for output.

    A closed stream is replaced by the null device, so that no other file takes its number. Characters that the encoding
    lacks are printed as escapes. Warnings are shown only with `-W` or PYTHONWARNINGS.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _CLOSED.add(number)
            nowhere = Path(os.devnull).open("r+", encoding="utf-8")  # noqa: SIM115  # takes the lowest free number
            os.set_inheritable(nowhere.fileno(), True)
            setattr(sys, name, nowhere)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        os.environ["PYTHONWARNINGS"] = "ignore"  # of worker processes


def output_is_closed() -> bool:
    """True if this process was started with a closed standard output."""
    return 1 in _CLOSED


def reader_is_gone() -> bool:
    """True if the reader of standard output has closed it."""
    return 1 in _DROPPED


def write(text: str, stream: IO[str]) -> None:
    """Output of a text with control characters replaced; raises OSError if standard output cannot be written."""
    with _lost(stream):
        print(printable(text), file=stream)


def flush() -> None:
    """Flush of both streams; raises OSError if standard output cannot be written."""
    for stream in (sys.stdout, sys.stderr):
        with _lost(stream):
            stream.flush()


@contextmanager
def _lost(stream: IO[str]) -> Iterator[None]:
    """Context that discards further output of a stream whose reader is gone, or of a failing standard error."""
    try:
        yield
    except OSError as problem:
        if stream is not sys.stderr and not isinstance(problem, BrokenPipeError):
            raise
        drop(stream)


def drop(stream: IO[str]) -> None:
    """Redirection of a stream to the null device, so that Python does not fail at exit."""
    _DROPPED.add(stream.fileno())
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
