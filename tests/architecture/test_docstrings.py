"""Docstrings, and the strings below constants and fields, begin with a noun phrase."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import ltsim
from tests.architecture.syntax import tree_of

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


SECTION = re.compile(
    r"(?:^|\n)(Parameters|Attributes|Returns)\n-+\n(.*?)(?=\n\n\S[^\n]*\n-+\n|\Z)",
    re.DOTALL,
)
"""Section of a docstring with its entries."""


def entries(node: ast.FunctionDef | ast.ClassDef) -> Iterator[tuple[str, list[str], str]]:
    """Section, names and description of each entry of the sections of a docstring."""
    for section, body in SECTION.findall(ast.get_docstring(node) or ""):
        for entry in re.split(r"\n(?=\S)", body):
            head, _, text = entry.partition("\n")
            names = [name.strip().lstrip("*") for name in head.partition(" : ")[0].split(",")]
            yield section, names, " ".join(text.split())


def described(node: ast.FunctionDef | ast.ClassDef) -> set[str]:
    """Names that a docstring may describe: parameters, or fields, methods and attributes of a class."""
    functions = (
        [node] if isinstance(node, ast.FunctionDef) else [n for n in node.body if isinstance(n, ast.FunctionDef)]
    )
    names = {
        argument.arg for function in functions for argument in ast.walk(function.args) if isinstance(argument, ast.arg)
    }
    if isinstance(node, ast.ClassDef):
        names |= {n.target.id for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
        names |= {function.name for function in functions}
        names |= {n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)}
    return names


def documented() -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    """Place and node of each function and class."""
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(tree_of(file)):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                yield f"{file.relative_to(PACKAGE.parent)}:{node.lineno}: {node.name}", node


def test_described_parameters_exist() -> None:
    wrong = [
        f"{place}: {name}"
        for place, node in documented()
        for section, names, _ in entries(node)
        for name in names
        if section != "Returns" and name not in described(node)
    ]
    assert not wrong, "\n".join(["no parameter or field has this name:", *wrong])


def test_descriptions_of_parameters_begin_with_what_they_describe() -> None:
    clauses = [
        f"{place}: {', '.join(names)}: {text[:60]}"
        for place, node in documented()
        for _, names, text in entries(node)
        if text and NO_NOUN.match(text)
    ]
    assert not clauses, "\n".join(["begin with a noun phrase:", *clauses])


PLAIN_WORDS = {
    "HA",
    "Hz",
    "S1_P01",
    "S2_P01",
    "haerror",
    "img",
    "sel",
    "shared_NAME_...",
    "pickle",
    "use_attribute_docstrings",
}
"""Words in backticks that are no names of ltsim: of other programs, and of examples."""


def names_of_package() -> set[str]:
    """All identifiers, modules, and words of string constants of the package."""
    names = {part.removesuffix(".py") for path in PACKAGE.rglob("*") for part in path.relative_to(PACKAGE.parent).parts}
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(tree_of(file)):
            fields = ("id", "attr", "name", "arg", "module", "asname")
            texts = [getattr(node, field, None) for field in fields]
            texts += [node.value] if isinstance(node, ast.Constant) else []
            for text in texts:
                if isinstance(text, str):
                    names |= {text, *re.split(r"[.,\s]", text)} if len(text) < 2000 else set()
    return names


def test_names_in_docstrings_exist() -> None:
    """A name in backticks is one of the package: a renamed one is renamed in the text too."""
    names = names_of_package() | PLAIN_WORDS
    strange = [
        f"{file.relative_to(PACKAGE.parent)}:{line}: {quoted}"
        for file in sorted(PACKAGE.rglob("*.py"))
        for line, text in strings(tree_of(file))
        for quoted in re.findall(r"(?<!`)`([A-Za-z_][\w.]*)(?:\(\))?`(?!`)", text)
        if quoted not in names and not all(part in names for part in quoted.split("."))
    ]
    assert not strange, "\n".join(["no such name:", *strange])


def test_docstrings_begin_with_what_they_describe() -> None:
    clauses = [
        f"{file.relative_to(PACKAGE.parent)}:{line}: {text.splitlines()[0][:60]}"
        for file in sorted(PACKAGE.rglob("*.py"))
        for line, text in strings(tree_of(file))
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
