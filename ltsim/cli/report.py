"""`ltsim report`: the page a person reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

import ltsim as lt
from ltsim.cli.places import Force, claim_file
from ltsim.cli.terminal import Quiet, Terminal
from ltsim.errors import SetupError
from ltsim.recording.settings import sentence
from ltsim.recording.setup import About

Folder = Annotated[
    Path, typer.Argument(metavar="DIR", help="A folder that another verb wrote, or one of such folders.")
]
Behind = Annotated[
    Path | None,
    typer.Option(
        "--recording", metavar="REC", help="The recording behind a calibration or diagnosis, if not near DIR."
    ),
]


Title = Annotated[str | None, typer.Option("--title", metavar="TEXT", help="Of the page.")]
Line = Annotated[str | None, typer.Option(metavar="TEXT", help="For the head; default from [report] of setup.toml.")]
Day = Annotated[str | None, typer.Option("--date", metavar="YYYY-MM-DD", help="Day of the measurement.")]


def report(
    folder: Folder,
    recording: Behind = None,
    title: Title = None,
    instrument: Line = None,
    date: Day = None,
    operator: Line = None,
    customer: Line = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Write report.html into DIR: one page that opens offline, the answer first, then tables, figures and the 3D view.

    DIR may hold a recording, a calibration, a diagnosis, a campaign, a plan, or folders of them. The head names
    instrument, date, operator and customer from the table [report] of setup.toml, or from the options; without a word
    there, the instruments by their model and serial.

    Coordinates stand in the axes in which they were computed: --frame belongs to adjust, calibrate, diagnose, convert.

    Example: ltsim report my-calibration --customer "Hall 3" --instrument "AT960, 751234"
    """
    from ltsim.pages.page import NAME

    terminal = Terminal(quiet)
    about = _about(instrument=instrument, date=date, operator=operator, customer=customer)
    claim_file(folder / NAME, force=force)
    with terminal.busy("drawing the report"):
        page = lt.report(folder, recording=recording, title=title, about=about, tell=terminal.note)
    terminal.say(f"written to {page}")


def _about(**given: str | None) -> About:
    """The options as a table of the set-up; raises SetupError."""
    try:
        return About.model_validate(given)
    except ValidationError as problem:
        raise SetupError(f"--{sentence(problem.errors()[0], About)}") from None
