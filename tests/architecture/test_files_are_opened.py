"""Files that a user names are opened in one place, which refuses pipes and devices: no reader waits for them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import ltsim

PACKAGE = Path(ltsim.__file__).parent
OPENING = {"open", "read_bytes", "read_text", "read_csv", "fromfile", "loadtxt", "genfromtxt", "read_table", "fdopen"}
"""Names of functions and methods that open a file."""
ALLOWED = {
    "core/storage.py": "the place itself",
    "cli/campaign.py": "a template of the package",
    "cli/examples.py": "samples of the package",
    "cli/terminal.py": "the null device",
    "cli/view.py": "the address of the page, in a browser",
    "planning/loading.py": "plans of the package",
    "recordings/spreadsheets/workbooks.py": "parts of an archive in memory",
    "recordings/specification.py": "a table of the package",
    "reports/board/server.py": "the page of the package",
    "scene/cad_process.py": "the limits of this process",
    "simulation/builtin/__init__.py": "scenarios of the package",
}
"""Modules that open other files, with the reason why no user names them."""


def opened(source: ast.Module) -> set[str]:
    """Names of the functions by which a module opens files; functions that take a path are ltsim's."""
    names = set()
    for node in ast.walk(source):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in OPENING:
            names.add(node.func.attr)
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("open", "fdopen"):
            names.add("open")
    return names


def test_files_of_the_user_are_opened_in_a_single_place() -> None:
    names_by_file = {
        path.relative_to(PACKAGE).as_posix(): names
        for path in sorted(PACKAGE.rglob("*.py"))
        if (names := opened(ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert {file: names for file, names in names_by_file.items() if file not in ALLOWED} == {}, "use `open_for_reading`"
    assert {*ALLOWED} <= {*names_by_file}


@pytest.mark.parametrize("text", ["open(path)", "path.open('rb')", "path.read_bytes()", "Path(p).read_text()"])
def test_the_search_finds_what_it_is_for(text: str) -> None:
    assert opened(ast.parse(text))
