"""Command `examples`: copies of sample data and commented files in a folder."""

from __future__ import annotations

from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from ltsim.cli.output_checks import COMPARED_FILE_OUTPUT, RESULT_FOLDER_OUTPUT, ForceOption, write_outputs
from ltsim.cli.terminal import Terminal
from ltsim.recordings.files import write_text
from ltsim.simulation.builtin import builtin_text

ExamplesFolderArgument = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder to write to."), RESULT_FOLDER_OUTPUT
]
COMMAND_BY_EXAMPLE_FILE = {
    "survey.csv": "ltsim diagnose survey.csv --frame hall.csv --out diagnosis",
    "hall.csv": "",
    "workshop.toml": "ltsim simulate workshop.toml --seed 7 --out recording",
    "machine-plan.toml": "ltsim plan machine-plan.toml --out machine-plan",
    "machine-points.csv": "",
    "campaign.toml": "ltsim campaign campaign.toml --set trials=100 --jobs 2",
    "uncertainty.toml": "ltsim uncertainty uncertainty.toml --out uncertainty",
    "acceptance.toml": "ltsim accept acceptance.toml --out acceptance",
    "calibration.ipynb": "jupyter lab calibration.ipynb",
    "hall.ipynb": "jupyter lab hall.ipynb",
    "sweep.ipynb": "jupyter lab sweep.ipynb",
}
"""Command to try for each example file, by file name; empty for an input file of the preceding command."""


def example_file_content(name: str) -> str:
    """Content of the example file with this name."""
    if name == "workshop.toml":
        return builtin_text("paper-workshop")
    package = files("ltsim")
    file = package / "campaigns" / "example.toml" if name == "campaign.toml" else package / "examples" / name
    return file.read_text(encoding="utf-8")


def examples(
    folder: ExamplesFolderArgument = Path("ltsim-examples"), force: ForceOption = False, *, terminal: Terminal
) -> None:
    """Copy sample data: a survey with its hall, a scenario, a plan, a campaign, tasks, notebooks.

    Every file is commented; a command to try is printed for each. Jupyter is not part of ltsim.

    Example: ltsim examples my-folder
    """
    for name in COMMAND_BY_EXAMPLE_FILE:
        COMPARED_FILE_OUTPUT.check(folder / name, force)
    write_outputs(
        {folder / name: partial(write_text, text=example_file_content(name)) for name in COMMAND_BY_EXAMPLE_FILE},
        force=force,
    )
    terminal.print_json(
        {
            "folder": str(folder),
            "files": list(COMMAND_BY_EXAMPLE_FILE),
            "commands": [line for line in COMMAND_BY_EXAMPLE_FILE.values() if line],
        }
    )
    terminal.print_text(f"written to {folder}; try there:")
    width = max(map(len, COMMAND_BY_EXAMPLE_FILE))
    for name, command in COMMAND_BY_EXAMPLE_FILE.items():
        terminal.print_text(f"  {name:{width}}  {command}".rstrip())
