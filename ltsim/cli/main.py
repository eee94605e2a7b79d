"""Program `ltsim` with its commands, exit statuses and error messages."""

import errno
import gc
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from importlib import import_module
from operator import itemgetter
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from ltsim.cli.options import typer_command
from ltsim.cli.terminal import discard_output, flush_streams, prepare_streams, write_line
from ltsim.core.errors import LtsimError, UserInterruptError, spell_options_as_flags
from ltsim.recordings.files import safe_excerpt

INVALID_INPUT_STATUS = 2
"""Exit status after invalid input or wrong usage."""
INTERNAL_ERROR_STATUS = 70
"""Exit status after an internal error."""
MAX_QUOTED_PATH_LENGTH = 80
"""Largest number of characters of an impossible path in a message."""
INTERRUPTED_STATUS = 130
"""Exit status after an interruption by the user: 128 plus the number of the signal (2 for Ctrl-C)."""
UNWRITABLE_OUTPUT_ERRNOS = (
    errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EBADF,
    errno.EMFILE, errno.ENFILE,
)  # fmt: skip
"""Error numbers of the operating system that mean that an output cannot be written (disk full, no permission)."""

IMPOSSIBLE_PATH_ERRNOS = (errno.ENAMETOOLONG, errno.ELOOP)
"""Error numbers of the operating system that mean that no file can have this path."""

# Typer brings its own copy of click or the library's, by version; its errors are reached through a public one.
UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")
"""Base class of Click's errors on wrong usage, taken from Typer's own copy of Click or from the installed Click."""

RepeatedOptionError: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
"""Class of Click's error that is raised for a repeated option."""

# To add a command: a function of its name in one of these modules, and one line here.
COMMANDS = {
    "demo": ("simulate", "simulate, calibrate, repeat, inject and diagnose a fault; one page"),
    "examples": ("examples", "sample data and commented files, copied into a folder"),
    "simulate": ("simulate", "simulate one recording of a virtual hall"),
    "check": ("check", "test in the field, go or no-go: two faces, drift, moved tripods"),
    "adjust": ("adjustment", "adjust the network of a recording, no instrument parameters"),
    "calibrate": ("adjustment", "estimate the instrument's parameters from a recording"),
    "correct": ("adjustment", "remove the instrument's errors from a recording"),
    "evaluate": ("adjustment", "disagreement of the stations, before and after a calibration"),
    "verify": ("adjustment", "apply a calibration to another recording"),
    "recover": ("campaign", "check in CI that injected instrument errors are recovered"),
    "campaign": ("campaign", "many simulated trials for combinations of factor levels"),
    "compare": ("check", "points that moved between two recordings"),
    "convert": ("convert", "convert a recording between formats"),
    "effects": ("effects", "the catalogue of physical effects"),
    "inject": ("simulate", "add the effect of a fault to a recording; test whether it is detected"),
    "diagnose": ("adjustment", "test whether recording and model agree; locate and name the causes"),
    "history": ("adjustment", "an instrument's parameters over several calibrations"),
    "plan": ("plan", "plan stations and reflectors, or the next measurement"),
    "report": ("view", "write one offline page about a folder of results"),
    "uncertainty": ("check", "uncertainty of lengths, circles, poses: budget and verdict"),
    "accept": ("check", "acceptance tests of a tracker: predicted or evaluated"),
    "bench": ("check", "range error of a reflector against incidence, from a bench test"),
    "view": ("view", "show the hall in 3D"),
}
"""Module in `ltsim.cli`, and line of the help, of each command by name."""
TYPER_SETTINGS: dict[str, Any] = {
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
"""Settings of Typer that hold for the program and for each command."""


def command_function(name: str) -> Callable[..., Any]:
    """Function of the command `name`; its module is imported here, on first use."""
    function: Callable[..., Any] = getattr(import_module(f"ltsim.cli.{COMMANDS[name][0]}"), name)
    return function


class SingleValueCommand(TyperCommand):
    """Command that rejects a repeated option which takes a single value; Click alone would use the last value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Arguments of the command that remain after its options; raises UsageError for a repeated option."""
        given_arguments = list(args)
        try:
            remaining = super().parse_args(ctx, args)
        except RepeatedOptionError as error:  # of an option without its value, which does not name the command
            error.ctx = error.ctx or ctx
            raise
        _, _, given_parameters = self.make_parser(ctx).parse_args(given_arguments)
        counts = Counter(p.opts[-1] for p in given_parameters if p.param_type_name == "option" and has_single_value(p))
        repeated_option, count = max(counts.items(), key=itemgetter(1), default=("", 0))
        if count > 1:
            raise RepeatedOptionError(f"{repeated_option} was given {count} times, and takes one value", ctx)
        return remaining


def has_single_value(option: Any) -> bool:
    """True for an option that takes one value, so that it may not be repeated."""
    return not (option.multiple or option.is_flag or option.count)


class CommandGroup(TyperGroup):
    """Group of commands that are imported on first use, so that help and simple commands start fast."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = dict.fromkeys(COMMANDS)  # type: ignore[assignment]  # names to suggest; `get_command` loads

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of the commands in the order in which the help lists them."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Command by its name; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        command_app = typer.Typer(add_completion=False, **TYPER_SETTINGS)
        command_app.command(cmd_name, cls=SingleValueCommand)(typer_command(command_function(cmd_name)))
        return typer.main.get_command(command_app)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Section of the help with one line per command, written to `formatter`."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, about) for name, (_, about) in COMMANDS.items()])


app = typer.Typer(cls=CommandGroup, name="ltsim", no_args_is_help=True, **TYPER_SETTINGS)


def print_version(is_requested: bool) -> None:
    """Output of the version of ltsim if `is_requested`; the program then ends."""
    if is_requested:
        from importlib.metadata import version

        write_line(f"ltsim {version('ltsim')}", sys.stdout)
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", callback=print_version, is_eager=True, help="Print the version and stop.")
]


@app.callback()
def ltsim(version: VersionOption = False) -> None:
    """Simulate, calibrate, plan and diagnose laser-tracker networks."""


def run(arguments: Sequence[str]) -> int:
    """Exit status of the program after it has run the command given by `arguments`.

    0 success, 1 a check failed, 2 invalid input or usage (one sentence on standard error), 70 internal error (with a
    traceback), 130 interrupted by the user.
    """
    try:
        with spell_options_as_flags():
            status = app(args=list(arguments) or ["--help"], prog_name="ltsim", standalone_mode=False)
        flush_streams()
    except UsageError as problem:
        return _report_invalid_input(_usage_error_sentence(problem))
    except UserInterruptError as stop:
        return _report_interruption(str(stop))
    except LtsimError as problem:
        return _report_invalid_input(str(problem))
    except (BrokenPipeError, SystemExit):
        # The reader of the pipe has closed it (`| head`); Typer exits for that reason only.
        discard_output(sys.stdout)
        return 0
    except (KeyboardInterrupt, typer.Abort):
        return _report_interruption()
    except Exception as problem:
        return _report_failure(problem)
    # Typer turns an interruption into this status and says nothing.
    return _report_interruption() if status == INTERRUPTED_STATUS else status if isinstance(status, int) else 0


def _report_interruption(remark: str = "no partial file remains") -> int:
    """Exit status after an interruption by the user; prints "interrupted" and `remark`."""
    write_line(f"interrupted; {remark}", sys.stderr)
    return INTERRUPTED_STATUS


def _report_failure(error: Exception) -> int:
    """Exit status after the output of an error that is no LtsimError.

    It is an internal error, an output that cannot be written (disk full), or a path that no file can have.
    """
    if isinstance(error, OSError) and error.errno in UNWRITABLE_OUTPUT_ERRNOS:
        discard_output(sys.stdout)
        return _report_invalid_input(f"{error.filename or 'the output'} cannot be written ({error.strerror})")
    if isinstance(error, OSError) and error.errno in IMPOSSIBLE_PATH_ERRNOS:
        path_text = safe_excerpt(str(error.filename), MAX_QUOTED_PATH_LENGTH)
        return _report_invalid_input(f"{path_text} cannot be opened ({error.strerror}); give the path of a file")
    write_line("".join(traceback.format_exception(error)).rstrip(), sys.stderr)
    cause = "the memory is not sufficient" if isinstance(error, MemoryError) else "internal error of ltsim"
    write_line(f"error: {cause} ({type(error).__name__}); please report it with the lines above", sys.stderr)
    return INTERNAL_ERROR_STATUS


def _usage_error_sentence(error: Any) -> str:
    """Sentence on wrong usage of a command, with the command that prints its help."""
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "ltsim"
    message = str(error.format_message()).rstrip(".")
    return f"{command}: {message}; see {command} --help" if message else f"see {command} --help"


def _report_invalid_input(message: str) -> int:
    """Exit status after invalid input or wrong usage; prints the error as one line."""
    write_line("error: " + " ".join(message.split()), sys.stderr)
    return INVALID_INPUT_STATUS


def main() -> None:
    """Entry point of the installed program `ltsim`."""
    prepare_streams()
    gc.set_threshold(50_000, 10, 10)  # collecting garbage took a tenth of the time of a page
    status = run(sys.argv[1:])
    flush_streams()
    sys.exit(status)
