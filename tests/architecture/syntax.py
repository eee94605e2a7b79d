"""Syntax trees of modules, shared by the tests of the architecture."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path


@cache
def tree_of(path: Path) -> ast.Module:
    """Syntax tree of a module, parsed once for all tests of a process."""
    return ast.parse(path.read_text(encoding="utf-8"))
