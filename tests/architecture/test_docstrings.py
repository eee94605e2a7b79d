"""Docstrings, and the strings below constants and fields, begin with a noun phrase."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import ltsim

PACKAGE = Path(ltsim.__file__).parent
CLAUSE = re.compile(r"\s*(What|That of|Of|Those|Whether it|Where|Which|How) ")


def strings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of each docstring, and of each string below an assignment."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.Assign, ast.AnnAssign)
        for above, here in zip([node, *body], body, strict=False):
            is_text = isinstance(here, ast.Expr) and isinstance(here.value, ast.Constant)
            if is_text and isinstance(here.value.value, str) and isinstance(above, documented):
                yield here.lineno, here.value.value


def test_docstrings_begin_with_what_they_describe() -> None:
    clauses = [
        f"{file.relative_to(PACKAGE.parent)}:{line}: {text.splitlines()[0][:60]}"
        for file in sorted(PACKAGE.rglob("*.py"))
        for line, text in strings(ast.parse(file.read_text(encoding="utf-8")))
        if CLAUSE.match(text)
    ]
    assert not clauses, "\n".join(["begin with a noun phrase:", *clauses])


def test_a_clause_is_seen() -> None:
    tree = ast.parse('"""What it is."""\nA = 1\n"""Of the mean."""\ndef f():\n    """Which of them."""\n')
    assert [line for line, text in strings(tree) if CLAUSE.match(text)] == [1, 3, 5]
