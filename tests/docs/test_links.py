"""No page points at what does not ship."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.conftest import ROOT

FOLDERS = ("docs", "experiments", "benchmarks", "results")
PAGES = [ROOT / "README.md", *(p for folder in FOLDERS for p in sorted((ROOT / folder).rglob("*.md")))]
PROJECT_PAGES = [p for p in PAGES if p.relative_to(ROOT).parts[0] in ("README.md", "docs")]
LINK = re.compile(r"\]\(<?([^)>\s]+)>?\)|^```\{(?:include|literalinclude|figure|image)\} (\S+)", re.MULTILINE)
OUTSIDE = re.compile(r"(?:\.\./)*shared/|physics\.md|interface\.md|mission\.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_lead_to_files_of_the_project(page: Path) -> None:
    for match in LINK.finditer(page.read_text(encoding="utf-8")):
        address = (match[1] or match[2]).partition("#")[0]
        if not address or address.startswith(("http://", "https://", "mailto:")):
            continue
        target = (page.parent / address).resolve()
        assert target.is_relative_to(ROOT), f"{address} is outside the project"
        assert target.exists(), f"there is no {address}"


@pytest.mark.parametrize("page", PROJECT_PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_page_of_the_documentation_speaks_of_files_that_do_not_ship(page: Path) -> None:
    assert OUTSIDE.findall(page.read_text(encoding="utf-8")) == []
