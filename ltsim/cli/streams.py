"""Standard output and standard error, which may be closed, full, without a reader, or in an encoding without a name."""

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
    """Make the streams of this process fit to print to.

    A closed one leads nowhere: the next file that is opened must not take its number. Characters that the encoding
    lacks are printed as escapes. Warnings are for whoever develops ltsim: they are shown where `-W` or
    PYTHONWARNINGS asks for them.
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
        os.environ.setdefault("PYTHONWARNINGS", "ignore")  # of the processes that work for this one
        os.environ["PYTHONWARNINGS"] = "ignore"  # of processes that work for this one


def output_is_closed() -> bool:
    """True when this process was started with a closed standard output."""
    return 1 in _CLOSED


def reader_is_gone() -> bool:
    """True when nobody reads standard output any more."""
    return 1 in _DROPPED


def write(text: str, stream: IO[str]) -> None:
    """Print a text, its control characters replaced; raises OSError for a standard output that takes no more."""
    with _lost(stream):
        print(printable(text), file=stream)


def flush() -> None:
    """Print what waits to be printed; raises OSError for a standard output that takes no more."""
    for stream in (sys.stdout, sys.stderr):
        with _lost(stream):
            stream.flush()


@contextmanager
def _lost(stream: IO[str]) -> Iterator[None]:
    """A stream whose reader is gone, or a standard error that takes no more, gets nothing any more."""
    try:
        yield
    except OSError as problem:
        if stream is not sys.stderr and not isinstance(problem, BrokenPipeError):
            raise
        drop(stream)


def drop(stream: IO[str]) -> None:
    """Let whatever is still printed to a stream go nowhere, so that Python does not complain about it at exit."""
    _DROPPED.add(stream.fileno())
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
