"""Every command and every piece of code in the documentation runs and prints what the page says."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from ltsim.physics.effects import CATALOGUE
from tests.conftest import ROOT
from tests.docs.snippets import blocks, check_page

OTHERS = ROOT / "docs" / "example-effect"
"""A package of its own, whose snippets need it installed: the tests of the catalogue run them."""
PAGES = [ROOT / "README.md", *(p for p in sorted((ROOT / "docs").rglob("*.md")) if OTHERS not in p.parents)]
RUNNING = [p for p in PAGES if any(b.runs and b.kind in ("sh", "python") for b in blocks(p))]
NEEDS = {"campaign-results.md": ("duckdb", "pandas", "xarray")}
"""What the recipes of a page need that ltsim does not."""


@pytest.fixture(autouse=True)
def catalogue() -> Iterator[None]:
    """Effects that a page adds are known on that page alone."""
    kept = dict(CATALOGUE.__dict__)
    yield
    CATALOGUE.__dict__.clear()
    CATALOGUE.__dict__.update(kept)


@pytest.mark.parametrize("page", RUNNING, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_page_does_what_it_says(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in NEEDS.get(page.name, ()):
        pytest.importorskip(package, reason=f"a recipe of {page.name} needs {package}")
    monkeypatch.chdir(tmp_path)
    assert check_page(page, tmp_path) > 0


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_page_has_no_block_of_an_unknown_kind(page: Path) -> None:
    """A misspelt language would keep a block from being run without a word."""
    known = {"sh", "python", "text", "toml", "yaml", "json", "csv", ""}
    unknown = [f"line {b.line}: {b.kind}" for b in blocks(page) if b.kind not in known and b.text.strip()]
    assert not unknown
