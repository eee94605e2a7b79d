"""`ltsim report`: the page a person reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import ltsim as lt
from ltsim.cli.options import Quiet
from ltsim.cli.places import Force, claim_file
from ltsim.cli.terminal import Terminal

Folder = Annotated[
    Path, typer.Argument(metavar="DIR", help="A folder that another verb wrote, or one of such folders.")
]
Behind = Annotated[
    Path | None,
    typer.Option(
        "--recording", metavar="REC", help="The recording behind a calibration or diagnosis, if not near DIR."
    ),
]


def report(folder: Folder, recording: Behind = None, force: Force = False, quiet: Quiet = False) -> None:
    """Write report.html into DIR: one page that opens offline, the answer first, then tables, figures and the 3D view.

    DIR may hold a recording, a calibration, a diagnosis, a campaign, a plan, or folders of them.

    Example: ltsim report my-calibration --recording my-recording
    """
    from ltsim.report.page import NAME

    terminal = Terminal(quiet)
    claim_file(folder / NAME, force=force)
    with terminal.busy("drawing the report"):
        page = lt.report(folder, recording=recording, tell=terminal.note)
    terminal.say(f"written to {page}")
