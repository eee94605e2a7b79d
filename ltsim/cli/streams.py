"""Standard output and error streams that may be closed, full, without reader, or in any encoding."""

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ltsim.core.errors import printable

_CLOSED_AT_START: set[int] = set()
"""File descriptors of the standard streams that were closed when the process started."""
_DROPPED_STREAMS: set[int] = set()
"""File descriptors of the standard streams whose further output is discarded."""


def prepare_streams() -> None:
    """Preparation of the standard streams of this process for output.

    A closed stream is replaced by the null device, so that no other file takes its number. Characters that the encoding
    lacks are printed as escapes. Warnings are shown only with `-W` or PYTHONWARNINGS.
    """
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _CLOSED_AT_START.add(descriptor)
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
    return 1 in _CLOSED_AT_START


def is_reader_gone() -> bool:
    """True if the program that reads standard output (such as `head`) has closed it."""
    return 1 in _DROPPED_STREAMS


def write_line(text: str, stream: IO[str]) -> None:
    """Output of a line whose control characters are replaced; raises OSError if standard output cannot be written."""
    with _discard_when_lost(stream):
        print(printable(text), file=stream)


def flush_streams() -> None:
    """Flush of both streams; raises OSError if standard output cannot be written."""
    for stream in (sys.stdout, sys.stderr):
        with _discard_when_lost(stream):
            stream.flush()


@contextmanager
def _discard_when_lost(stream: IO[str]) -> Iterator[None]:
    """Context after which a stream discards its output, if its reader is gone or standard error cannot be written.

    Raises OSError if standard output cannot be written for another reason.
    """
    try:
        yield
    except OSError as problem:
        if stream is not sys.stderr and not isinstance(problem, BrokenPipeError):
            raise
        discard_output(stream)


def discard_output(stream: IO[str]) -> None:
    """Redirection of a stream to the null device, so that Python does not fail at exit."""
    _DROPPED_STREAMS.add(stream.fileno())
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, stream.fileno())
    os.close(null_device)
