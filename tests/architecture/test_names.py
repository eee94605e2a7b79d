"""Identifiers are nouns of the field: no participle, pronoun or adverb is the name of a value, function or module."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import ltsim

PACKAGE = Path(ltsim.__file__).parent
PARTS = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")})
WORDS = {
    *("alike", "apart", "beside", "found", "kept", "known", "left", "mended", "one", "own"),
    *("said", "seen", "some", "stated", "stray", "told"),
}
"""Words that say when or by whom a value came to be, and not what it is."""
KEYS = {"known_mm", "known_sigma_mm", "known_covariance_mm2", "known_axes"}
"""Keys of setup.toml that the format of a recording fixes."""


def words_of(name: str) -> set[str]:
    """Words of an identifier, at underscores and capitals, in lower case."""
    return {part.lower() for part in re.split(r"_|(?<=[a-z])(?=[A-Z])", name) if part}


def defined(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and name of each variable, argument, function, class, attribute and import alias that a module defines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.alias) and node.asname:
            yield node.lineno, node.asname
        elif isinstance(node, ast.ExceptHandler) and node.name:
            yield node.lineno, node.name


def offences(part: str) -> list[str]:
    """Places of a package, or of a module beside the packages, whose names hold one of `WORDS`."""
    folder = PACKAGE / part
    bad = []
    for file in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]:
        names = [(1, file.stem), *defined(ast.parse(file.read_text(encoding="utf-8")))]
        names = [(line, name) for line, name in names if name not in KEYS]
        bad += [f"{file.relative_to(PACKAGE.parent)}:{line}: {name}" for line, name in names if words_of(name) & WORDS]
    return bad


@pytest.mark.parametrize("part", PARTS)
def test_names_say_what_a_value_is(part: str) -> None:
    bad = offences(part)
    assert not bad, "\n".join(["name what the value is, not when it came to be:", *bad])


def test_each_kind_of_name_is_looked_at() -> None:
    tree = ast.parse(
        "import os as own\n"
        "class Known:\n    def told(self, left_over, *some): self.seen = found = left_over\n"
        "try: pass\nexcept OSError as said: pass\n"
    )
    names = {name for _, name in defined(tree) if words_of(name) & WORDS}
    assert names == {"own", "Known", "told", "left_over", "some", "seen", "found", "said"}
    assert not words_of("unknown_name") & WORDS and not words_of("foundation") & WORDS
