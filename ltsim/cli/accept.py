"""`ltsim accept`: acceptance tests of a tracker, predicted or judged."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ltsim.cli.options import Out
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal, table

if TYPE_CHECKING:
    from ltsim.acceptance.files import AcceptanceFile

AcceptFile = Annotated[Path, typer.Argument(metavar="FILE", help="An acceptance file (ltsim-acceptance/1).")]


def accept(file: AcceptFile, out: Out = None, force: Force = False, *, terminal: Terminal) -> int:
    """Predict acceptance tests of a tracker, or judge errors that were found, against its maker's limits.

    Writes accept.json and accept.csv to --out. Exit status 1 when an error that was found is over its limit.

    Example: ltsim accept my-tracker.toml --out acceptance
    """
    import ltsim as lt
    from ltsim.acceptance.files import TESTS, AcceptanceFile, write_acceptance

    claim(out, AcceptanceFile, (TESTS.file,), force=force)
    with terminal.busy("looking at the tests"):
        content = lt.accept(file)
    if out is not None:
        content = write_acceptance(content, out)
    terminal.answer(content.content())
    show(terminal, content)
    terminal.written(out)
    return int(content.kind != "predicted" and content.passes < 1)


def show(terminal: Terminal, content: AcceptanceFile) -> None:
    """The answer, a line a group, and what the tests are blind to."""
    from ltsim.acceptance.files import passes_words

    terminal.say(content.sentence)
    if content.assumption:
        terminal.say(f"assumed: {content.assumption}")
    rows = [
        [g.name, str(g.tests), passes_words(content, g.passes), f"{100 * g.largest_share:.0f} %"]
        for g in content.groups
    ]
    terminal.say("")
    share = "error + U over limit" if content.kind == "predicted" else "error over limit"
    terminal.say(table(["tests", "number", "passed", share], rows, left=1))
    worst = content.worst_passing
    if worst is not None:
        blind = [s.name for s in content.sensitivities if s.smallest_failing is None]
        if blind:
            terminal.say(f"\nno test sees {', '.join(blind)}")
        terminal.say(
            f"an instrument can pass every test and still place points {worst.rms_um:.0f} um off "
            f"({worst.largest_um:.0f} um at most), 1.5 to 9 m away"
        )
