"""Docstrings, and the strings below constants and fields, begin with a noun phrase."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import ltsim

PACKAGE = Path(ltsim.__file__).parent
PRONOUNS = (
    "anything|everybody|everything|he|his|it|its|itself|nobody|none|nothing|one|some|somebody|something|such|"
    "that|their|themselves|these|they|this|those"
)
"""Words in the place of the noun that says what is described."""
CLAUSES = (
    "as|because|how|if|since|so|unless|until|what|whatever|when|where|wherever|whether|which|while|who|"
    "whoever|whose|why"
)
"""Words that begin a clause."""
PREPOSITIONS = "after|among|at|before|beside|between|by|for|from|in|of|on|over|per|to|under|with|without"
"""Words that begin the description of a noun that is not there."""
UNIT = r"\s*(?:\[[^]]*\]\s*)?"
"""Unit ahead of a description."""
SHAPE = r"\("
"""Shape ahead of a description."""
NO_NOUN = re.compile(rf"{UNIT}(?:{SHAPE}|({PRONOUNS}|{CLAUSES}|{PREPOSITIONS})(?![\w-]))", re.IGNORECASE)


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
        if NO_NOUN.match(text)
    ]
    assert not clauses, "\n".join(["begin with a noun phrase:", *clauses])


@pytest.mark.parametrize(
    "start", ["What it is.", "Of the mean.", "[m] From one end.", "One test.", "Its name.", "None.", "(n, 3) Points."]
)
def test_a_missing_noun_is_an_offence(start: str) -> None:
    assert NO_NOUN.match(start)


@pytest.mark.parametrize(
    "start", ["Offset.", "One-sided limit.", "[m] Distance from one end.", "Bytes of it.", "Format"]
)
def test_a_noun_is_none(start: str) -> None:
    assert not NO_NOUN.match(start)
