"""Gallery: commands that are run while the page is built, and the pictures of the resulting report."""

import contextlib
import re
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from from_code.pictures import Pictures
from from_code.shell import commands, execute
from ltsim.reports.page import document_of_folder


@cache
def _workplace() -> TemporaryDirectory[str]:
    """Temporary folder for all commands of the page; it is deleted at the end of the build."""
    return TemporaryDirectory()


def shown(pictures: Pictures, lines: list[str], folder: str) -> str:
    """Markdown with the commands in `lines`, which are run, and the pictures of the report about `folder`."""
    place = Path(_workplace().name)
    with contextlib.chdir(place):
        for command in commands("\n".join(lines)):
            outcome = execute(command)
            if not outcome.right:
                raise RuntimeError(f"{command}: {outcome.said}")
        sections = document_of_folder(Path(folder)).sections
    parts = ["```sh", *lines, f"ltsim report {folder}", "```", ""]
    for section in sections:
        for block in section.blocks:
            if block.kind == "picture":
                name = re.sub(r"\W+", "-", f"{folder}-{block.title}".lower())
                image = pictures.keep(name, block.data_uri, block.caption)
                parts += [f"**{block.title}**", "", image, "", block.caption, ""]
    return "\n".join(parts)
