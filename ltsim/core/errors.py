"""Exceptions of ltsim, the condition under which each is raised, and the errors that several packages raise.

* `RecordError`: a file or a recording is malformed. The message is one sentence with file, row, column, value, and the
  expected value.
* `InputError`: a scenario, a campaign file, a plan file or an option cannot be carried out.
* `ModelError`: an argument of a Python function has a wrong shape, unit or name.
* `NetworkError`: the recording is well formed, but its network has no unique solution, for example because a station
  shares too few targets with the others.

A solver that does not converge raises no exception. It returns a `Solution` whose status says so in a sentence, and
`Solution.require_success()` raises `ConvergenceError` for callers who want an exception.
"""

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec

MAX_QUOTED_COLUMNS = 12
"""Largest number of titles of columns that a message on a missing column lists: two lines of a terminal."""


class LtsimError(Exception):
    """Base class of the exceptions of ltsim; the command line prints the message and exits with status 2."""


class RecordError(LtsimError):
    """Error in the content of a recording or another input file.

    Parameters
    ----------
    message : str
        Invalid value, and the expected value.
    file, row, column
        Location of the value, None where it is unknown; `row` counts data rows from 1 (the header is row 0, which
        the message names `header`).
    """

    def __init__(
        self,
        message: str,
        *,
        file: object | None = None,
        row: int | None = None,
        column: str | None = None,
    ) -> None:
        self.file, self.row, self.column = file, row, column
        location_texts = [] if file is None else [str(file)]
        location_texts += [] if row is None else [f"row {row}" if row else "header"]
        location_texts += [] if column is None else [f"column {column}"]
        super().__init__(", ".join(location_texts) + ": " + message if location_texts else message)


class InputError(LtsimError):
    """Error in a scenario, campaign, plan or option that cannot be carried out; the message says what to change."""


@contextmanager
def reraise_as_input_error(error_location: str = "") -> Iterator[None]:
    """Context that converts RecordError, InputError and ModelError to InputError, with `error_location` as prefix."""
    try:
        yield
    except (RecordError, InputError, ModelError) as problem:
        raise InputError(f"{error_location}: {problem}" if error_location else str(problem)) from None


class ModelError(LtsimError):
    """Error in an argument of a Python function: a wrong shape, unit or name."""


class NetworkError(LtsimError):
    """Error for a recording whose network has no unique solution; the message names the stations or targets."""


class WorkerError(LtsimError):
    """Error for a worker process that ended before its result was complete."""


class UserInterruptError(LtsimError):
    """Error for work that the user interrupted; the message states which results are complete and how to continue."""


class CalibratorError(LtsimError):
    """Error for a trial in which an external calibrator returns no valid result, although its input is valid.

    The recovery check of the calibrator then fails. If the calibrator is a program, the message contains its command,
    its exit status and the last line of its output.
    """


class ConvergenceError(LtsimError):
    """Error for an iteration that did not converge; its attribute `solution` is the `Solution` after the last step."""

    def __init__(self, message: str, solution: object) -> None:
        self.solution = solution
        super().__init__(message)


MAX_QUOTED_NAME_LENGTH = 60
"""Largest number of characters of a name that a message quotes in full; longer names are shortened."""
_OPTION_SPELLING_SWITCH = {"flags": False}
"""Switch of the spelling of options in messages: command-line flags (`--jobs`) if true, Python arguments (`jobs`) if
false."""
FLAG_BY_ARGUMENT_NAME = {
    "with_effects": "--with", "scaled": "--scale", "hints": "--hint", "changes": "--set",
    "calibrate=False": "--no-calibrate",
}  # fmt: skip
"""Command-line flag of each Python argument whose flag is not its name with hyphens in place of underscores."""


@contextmanager
def spell_options_as_flags() -> Iterator[None]:
    """Context in which `option_text` spells names as flags of the command line."""
    before, _OPTION_SPELLING_SWITCH["flags"] = _OPTION_SPELLING_SWITCH["flags"], True
    try:
        yield
    finally:
        _OPTION_SPELLING_SWITCH["flags"] = before


def option_text(argument_name: str) -> str:
    """Name of an option as the user writes it: `resume=True` in Python, `--resume` on the command line."""
    if not _OPTION_SPELLING_SWITCH["flags"]:
        return argument_name
    return FLAG_BY_ARGUMENT_NAME.get(argument_name) or "--" + argument_name.removesuffix("=True").replace("_", "-")


def missing_extra_error(feature_name: str, extra_name: str) -> InputError:
    """InputError for a feature that needs the optional dependencies `extra_name`, with the command that installs them.

    `feature_name` is the subject of the message, in the plural.
    """
    return InputError(f"{feature_name} need the extra '{extra_name}': pip install \"ltsim[{extra_name}]\"")


def require_extra(package_names: Sequence[str], feature_name: str, extra_name: str) -> None:
    """Check that `package_names` are installed; otherwise InputError with the command that installs `extra_name`.

    `extra_name` is the group of optional dependencies that contains the packages, `feature_name` the feature that needs
    it.
    """
    if not all(is_installed(name) for name in package_names):
        raise missing_extra_error(feature_name, extra_name)


def is_installed(package_name: str) -> bool:
    """True if a package is installed, so that it can be imported."""
    try:
        return find_spec(package_name) is not None
    except ValueError:  # it was hidden from this process
        return False


def as_printable(text: str) -> str:
    """Text with `?` in place of control characters, including those that change the direction of writing.

    The result is safe on a terminal and, after escaping, on an HTML page. Line breaks, tabs and no-break spaces remain.
    """
    return "".join(c if c.isprintable() or c in "\n\t\u00a0" else "?" for c in text)


def shortened_name(name: str) -> str:
    """Printable name of at most `MAX_QUOTED_NAME_LENGTH` characters for a message."""
    return as_printable(name if len(name) <= MAX_QUOTED_NAME_LENGTH else f"{name[:MAX_QUOTED_NAME_LENGTH]}...")


def unknown_name_error(object_kind: str, unknown_name_text: str, valid_names: Iterable[str]) -> ModelError:
    """ModelError for an unknown name; it lists similar `valid_names`. `object_kind` is a noun such as `effect`."""
    choices = sorted(valid_names)
    short = shortened_name(unknown_name_text)
    similar_names = difflib.get_close_matches(short, choices, n=3, cutoff=0.4) or choices
    return ModelError(f"there is no {object_kind} called '{short}'; did you mean {', '.join(similar_names)}?")


def require_columns(header: Sequence[str], required_names: Sequence[str], file: object | None = None) -> None:
    """Check that the header of a table has each required column once; raises RecordError with the name of the file."""
    for name in required_names:
        if name not in header:
            raise RecordError(missing_column_text(name, header), file=file, row=0)
        if header.count(name) > 1:
            raise RecordError(f"the column {name} is there twice; remove one of the two", file=file, row=0)


def missing_column_text(name: str, header: Sequence[str]) -> str:
    """Message on a required column that a table lacks: its name, the columns in the `header`, and the next action."""
    similar_names = difflib.get_close_matches(name, header, n=1, cutoff=0.6)
    columns = ", ".join(shortened_name(title) for title in header[:MAX_QUOTED_COLUMNS])
    more = f" and {len(header) - MAX_QUOTED_COLUMNS} more" if len(header) > MAX_QUOTED_COLUMNS else ""
    change = f"rename '{shortened_name(similar_names[0])}', if it" if similar_names else "rename the column that"
    return (
        f"the required column {name} is missing; the header has the columns {columns or '(none)'}{more}; "
        f"{change} contains these values, or add the column"
    )
