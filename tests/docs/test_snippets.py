"""Every command and every piece of code in the documentation runs and prints what the page says."""

from __future__ import annotations

import ast
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

import ltsim as lt
from ltsim.cli.main import app
from ltsim.physics.effects import CATALOGUE
from tests.conftest import ROOT
from tests.docs.snippets import blocks, check_page, commands

OTHERS = ROOT / "docs" / "example-effect"
"""A package of its own, whose snippets need it installed: the tests of the catalogue run them."""
PAGES = [ROOT / "README.md", *(p for p in sorted((ROOT / "docs").rglob("*.md")) if OTHERS not in p.parents)]
RUNNING = [p for p in PAGES if any(b.runs and b.kind in ("sh", "python") for b in blocks(p))]
NEEDS = {"campaign-results.md": ("duckdb", "pandas", "xarray")}
"""What the recipes of a page need that ltsim does not."""
MINUTES = {
    "campaign-results.md", "faces-control-levels.md", "next-measurement.md", "own-campaign.md", "own-hall.md",
    "own-tracker.md", "recovery-in-ci.md", "tutorial.md",
}  # fmt: skip
"""Pages with campaigns, searches and diagnoses of their own, which only the long run executes."""
LATER = [p for p in RUNNING if p.name in MINUTES or any(b.long for b in blocks(p))]
"""Pages of which a part is executed in the long run alone."""


@pytest.fixture(autouse=True)
def catalogue() -> Iterator[None]:
    """Effects that a page adds are known on that page alone."""
    saved_catalogue = dict(CATALOGUE.__dict__)
    yield
    CATALOGUE.__dict__.clear()
    CATALOGUE.__dict__.update(saved_catalogue)


@pytest.mark.parametrize(
    ("page", "long"),
    [
        *(pytest.param(p, False, id=p.name) for p in RUNNING if p.name not in MINUTES),
        *(pytest.param(p, True, id=f"{p.name}, all of it", marks=pytest.mark.long) for p in LATER),
    ],
)
def test_page_does_what_it_says(page: Path, long: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in NEEDS.get(page.name, ()):
        pytest.importorskip(package, reason=f"a recipe of {page.name} needs {package}")
    monkeypatch.chdir(tmp_path)
    assert check_page(page, tmp_path, long=long) > 0


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_page_has_no_block_of_an_unknown_kind(page: Path) -> None:
    """A misspelt language would keep a block from being run without a word."""
    kinds = {"sh", "python", "text", "toml", "yaml", "json", "csv", ""}
    unknown = [f"line {b.line}: {b.kind}" for b in blocks(page) if b.kind not in kinds and b.text.strip()]
    assert not unknown


@pytest.mark.parametrize("page", LATER, ids=lambda p: p.name)
def test_page_names_commands_options_and_functions_that_there_are(page: Path) -> None:
    """What only the long run executes is parsed in each: commands with their options, code with its names of `lt`."""
    verbs, count = typer.main.get_command(app), 0
    for block in (b for b in blocks(page) if b.runs):
        if block.kind == "python":
            for node in ast.walk(ast.parse(block.text)):
                if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "lt":
                    assert hasattr(lt, node.attr), f"line {block.line}: lt.{node.attr}"
                    count += 1
        for command in commands(block.text) if block.kind == "sh" else ():
            words = [] if "\n" in command else shlex.split(command, comments=True)
            if words[:1] == ["ltsim"]:
                words = words[: next((i for i, word in enumerate(words) if word in ("|", ">")), len(words))]
                verb = verbs.get_command(None, words[1])
                assert verb is not None, f"line {block.line}: {command}"
                verb.make_context(words[1], words[2:])  # raises on an option that there is not
                count += 1
    assert count
