"""The blocks of a page of documentation, run in order in a folder of their own, as a reader would.

A ``sh`` block is run command by command, a ``python`` block as a whole; a ``text`` block behind one of them is what it
prints, where ``...`` stands for anything. A block whose first line is a comment with a file's name, as ``# hall.toml``,
is that file. ``<!-- not run: why -->`` before a block keeps it from being run, ``<!-- long run: why -->`` from each run
but the long one.
"""

from __future__ import annotations

import contextlib
import doctest
import io
import re
import shutil
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.conftest import ROOT

sys.path.insert(0, str(ROOT / "docs"))

from from_code.shell import commands, execute

BLOCK = re.compile(
    r"(?:<!-- (?P<mark>not run|long run): [^>]+ -->\n\s*)?"
    r"^(?P<fence>```+)(?P<kind>\w*)[^\n]*\n(?P<text>.*?)^(?P=fence)\s*$",
    re.MULTILINE | re.DOTALL,
)
FILE = re.compile(r"# (?P<name>[\w./-]+\.(?:toml|py|csv|txt|yml))\n")
DOCTEST_FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@dataclass(frozen=True)
class Block:
    """A fenced block: language, text, the line it begins in, whether it is run, and whether only in the long run."""

    kind: str
    text: str
    line: int
    runs: bool
    long: bool


def blocks(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page."""
    content = page.read_text(encoding="utf-8")
    for match in BLOCK.finditer(content):
        line = content.count("\n", 0, match.start("fence")) + 1
        yield Block(match["kind"], match["text"], line, match["mark"] != "not run", match["mark"] == "long run")


def check_page(page: Path, folder: Path, *, long: bool) -> int:
    """Run the blocks of a page, in the long run or in another, in a folder that is the current one; how many ran."""
    for neighbour in page.parent.iterdir():
        if neighbour.suffix == ".csv" or neighbour.name.startswith("example-"):
            (shutil.copytree if neighbour.is_dir() else shutil.copy)(neighbour, folder / neighbour.name)
    for room in ("docs", "experiments"):  # a reader's checkout
        (folder / room).symlink_to(ROOT / room)
    names: dict[str, object] = {"__name__": "__main__"}
    count, printed = 0, None
    for block in blocks(page):
        where = f"{page.name}, line {block.line}"
        file = FILE.match(block.text)
        if not block.runs or (block.long and not long):
            printed = None
        elif file:
            (folder / file["name"]).write_text(block.text, encoding="utf-8")
        elif block.kind in ("sh", "python"):
            printed = _shell(block.text, where) if block.kind == "sh" else _python(block.text, where, names)
            count += 1
        elif block.kind == "text" and printed is not None:
            same = doctest.OutputChecker().check_output(block.text, printed, DOCTEST_FLAGS)
            assert same, f"{where}: the page says\n{block.text}\nbut it prints\n{printed}"
            printed = None
    return count


def _python(text: str, where: str, names: dict[str, object]) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(compile(text, where, "exec"), names)
    return out.getvalue()


def _shell(text: str, where: str) -> str:
    printed = ""
    for command in commands(text):
        outcome = execute(command)
        assert outcome.right, f"{where}: {command}\n{outcome.said}"
        printed += outcome.printed
    return printed
