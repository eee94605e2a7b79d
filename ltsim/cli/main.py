"""The command `ltsim`: which verbs there are, and what an error looks like."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

import typer

from ltsim.cli.adjust import adjust
from ltsim.cli.calibrate import calibrate
from ltsim.cli.campaign import campaign
from ltsim.cli.convert import convert
from ltsim.cli.correct import correct
from ltsim.cli.demo import demo
from ltsim.cli.diagnose import diagnose
from ltsim.cli.effects import effects
from ltsim.cli.evaluate import evaluate
from ltsim.cli.history import history
from ltsim.cli.plan import plan
from ltsim.cli.recover import recover
from ltsim.cli.report import report
from ltsim.cli.simulate import simulate
from ltsim.cli.verify import verify
from ltsim.cli.view import view
from ltsim.errors import LtsimError

BAD_INPUT = 2

# Typer brings its own copy of click or the library's, by version; its errors are reached through a public one.
UsageProblem: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    name="ltsim",
    help="Simulate, calibrate, plan and diagnose laser-tracker networks.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
# To add a verb: one import above, one line here.
app.command()(demo)
app.command()(simulate)
app.command()(adjust)
app.command()(calibrate)
app.command()(correct)
app.command()(evaluate)
app.command()(verify)
app.command()(recover)
app.command()(campaign)
app.command()(convert)
app.command()(effects)
app.command()(diagnose)
app.command()(history)
app.command()(plan)
app.command()(report)
app.command()(view)


def run(arguments: Sequence[str]) -> int:
    """Run the command with `arguments`; the exit status.

    0 done, 1 a check failed, 2 bad input or bad usage (one sentence on standard error), 130 interrupted.
    """
    try:
        status = app(args=list(arguments) or ["--help"], prog_name="ltsim", standalone_mode=False)
    except UsageProblem as problem:
        return _refuse(_usage_sentence(problem))
    except LtsimError as problem:
        return _refuse(str(problem))
    except BrokenPipeError:
        # The reader of the pipe has gone (`| head`); Python must not complain about that at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted; nothing half-written was left", file=sys.stderr)
        return 130
    return status if isinstance(status, int) else 0


def _usage_sentence(problem: Any) -> str:
    """What is wrong with the usage, and where help is."""
    context = getattr(problem, "ctx", None)
    place = context.command_path if context is not None else "ltsim"
    message = str(problem.format_message()).rstrip(".")
    return f"{place}: {message}; see {place} --help" if message else f"see {place} --help"


def _refuse(message: str) -> int:
    print("error: " + " ".join(message.split()), file=sys.stderr)
    return BAD_INPUT


def main() -> None:
    """Entry point of the installed command."""
    sys.exit(run(sys.argv[1:]))
