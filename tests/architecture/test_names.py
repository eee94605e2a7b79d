"""Identifiers are nouns of the field: no participle, pronoun or adverb is the name of a value, function or module."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from pathlib import Path

import pytest

import ltsim
from tests.architecture.syntax import tree_of

PACKAGE = Path(ltsim.__file__).parent
PARTS = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")})
CHECKOUT_FOLDERS = ("benchmarks", "experiments", "tests")
"""Folders of the checkout next to the package whose names are also checked."""
WORDS = {
    *("alike", "apart", "beside", "found", "kept", "known", "left", "mended", "one", "own"),
    *("said", "seen", "some", "stated", "stray", "told"),
}
"""Words that say when or by whom a value came to be, and not what it is."""
ADJECTIVES = {
    *("alone", "clear", "clean", "coarse", "common", "dense", "different", "distinct", "early", "equal", "equivalent"),
    *("even", "far", "fine", "flat", "full", "further", "idle", "joint", "large", "late", "likely", "long", "loose"),
    *("loud", "near", "new", "odd", "old", "only", "other", "plain", "quiet", "raw", "safe", "same", "separate"),
    *("sharp", "short", "silent", "similar", "slight", "small", "sparse", "still", "sure", "tight", "tiny", "unlikely"),
    *("whole", "wide", "best", "worst", "coarsest", "finest", "largest", "likeliest", "smallest"),
    *("finer", "larger", "smaller", "wider", "worse"),
}
"""Adjectives, which say how a value is, and not what it is."""
PARTICIPLES = {
    *(
        "bent",
        "bound",
        "broken",
        "built",
        "chosen",
        "drawn",
        "felt",
        "given",
        "grown",
        "held",
        "hidden",
        "lost",
        "made",
    ),
    *("met", "shown", "sought", "spent", "swept", "taken", "thrown", "worn", "written"),
}
"""Irregular participles, which say when a value came to be; regular ones end in `ed`."""
NOUNS_AND_VERBS = {"embed", "feed", "need", "proceed", "red", "seed", "speed"}
"""Words in `ed` that are no participles."""
PREPOSITIONS = {
    *("across", "after", "against", "along", "among", "around", "at", "before", "beneath", "between", "beyond"),
    *("during", "in", "of", "on", "onto", "over", "through", "towards", "under", "upon", "within"),
}
"""Prepositions: a name that begins with one lacks the noun. `by`, `from`, `to`, `with` and `without` are customary."""
NOT_PARAMETERS = {
    *("above", "after", "ahead", "also", "among", "apart", "around", "at", "before", "below", "beneath", "between"),
    *("beyond", "by", "during", "each", "else", "every", "here", "in", "inside", "into", "now", "of", "off", "on"),
    *("once", "otherwise", "over", "past", "per", "rest", "same", "some", "there", "to", "under", "up", "upon", "what"),
    *("where", "which", "who", "whole", "whom", "whose", "with", "within", "without"),
    *("chosen", "compared", "confined", "curved", "done", "drop", "earlier", "explained", "few", "fixed", "flat"),
    *("free", "further", "given", "good", "high", "joined", "joint", "largest", "last", "least", "likeliest", "low"),
    *("made", "more", "most", "near", "new", "next", "nominal", "old", "omitted", "ordinary", "other", "others"),
    *(
        "packed",
        "part",
        "parts",
        "plausible",
        "previous",
        "printed",
        "published",
        "quiet",
        "quieter",
        "raw",
        "refitted",
    ),
    *("rejected", "repeated", "required", "restored", "scaled", "settled", "shared", "shipped", "shown", "single"),
    *("sought", "strict", "taken", "thing", "things", "tried", "true", "usual", "valid", "visible", "wanted"),
    *("withheld", "work"),
}
"""Words that are no parameter of a function: adverbs, prepositions, pronouns, adjectives, participles, vague nouns."""
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


LAWS = PACKAGE.parent / "experiments" / "20_concealed_physics" / "laws"
"""Laws of the examination, which stay as their authors wrote them."""


def offences(part: str) -> list[str]:
    """Places of a package, of a module beside the packages, or of a folder of the checkout with one of `WORDS`."""
    folder = PACKAGE.parent / part if part in CHECKOUT_FOLDERS else PACKAGE / part
    bad = []
    files = sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
    for file in (file for file in files if file.parent != LAWS):
        names = [(1, file.stem), *defined(tree_of(file))]
        names = [(line, name) for line, name in names if name not in KEYS]
        bad += [f"{file.relative_to(PACKAGE.parent)}:{line}: {name}" for line, name in names if words_of(name) & WORDS]
    return bad


def is_stored_name(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)


def constants(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Line, name and value of each constant of a module; the values of a tuple are those of its members."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [n.id for t in targets for n in ast.walk(t) if is_stored_name(n)]
            values = node.value.elts if len(names) > 1 and isinstance(node.value, ast.Tuple) else [node.value]
            for name, value in zip(names, values, strict=len(names) == len(values)):
                if name.isupper():
                    yield node.lineno, name, ast.unparse(value)


def vague_parameters(tree: ast.AST, options: Collection[str] = ()) -> Iterator[tuple[int, str]]:
    """Line, function and name of each parameter in `NOT_PARAMETERS`, except of the functions `options`, whose
    parameters are options of the command line.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.name not in options and not node.name.startswith("__"):
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            arguments += [a for a in (node.args.vararg, node.args.kwarg) if a is not None]
            for argument in arguments:
                if argument.arg.strip("_") in NOT_PARAMETERS:
                    yield argument.lineno, f"{node.name}({argument.arg})"


def is_without_noun(name: str) -> bool:
    """True for one word that is a participle or an adjective, and for a name that begins with a preposition."""
    words = [word.lower() for word in name.split("_") if word]
    word = words[0] if words else ""
    is_participle = word in PARTICIPLES or (word.endswith("ed") and word not in NOUNS_AND_VERBS)
    return word in PREPOSITIONS or (len(words) == 1 and (is_participle or word in ADJECTIVES))


def lacks_decision(constant: str) -> bool:
    """True for a constant such as `MAX_LISTED_ITEMS`: a limit is `MAX_...` or `MIN_...` of a named quantity."""
    return constant.strip("_").split("_")[0] in ("LEAST", "MOST", "FEW", "MANY", "MOSTLY")


def nameless(part: str) -> list[str]:
    """Places of a package, or of a module beside the packages, whose functions or constants have no noun."""
    folder, bad = PACKAGE / part, []
    for file in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]:
        tree = tree_of(file)
        functions = [(n.lineno, n.name) for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
        limits = [(line, name) for line, name, _ in constants(tree)]
        names = [(line, name) for line, name in functions + limits if is_without_noun(name)]
        names += [(line, name) for line, name in limits if lacks_decision(name)]
        bad += [f"{file.relative_to(PACKAGE.parent)}:{line}: {name}" for line, name in sorted(set(names))]
    return bad


@pytest.mark.parametrize("part", PARTS)
def test_a_parameter_is_named_by_what_it_is(part: str) -> None:
    folder, bad = PACKAGE / part, []
    for file in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]:
        tree = tree_of(file)
        names = () if part == "cli" else vague_parameters(tree, ltsim.__all__)  # of a command they are options
        bad += [f"{file.relative_to(PACKAGE.parent)}:{line}: {name}" for line, name in names]
    assert not bad, "\n".join(["name the parameter with a noun:", *bad])


def test_a_parameter_without_noun_is_an_offence() -> None:
    tree = ast.parse(
        "def f(before, n_rows, *rest, drop=1, **more): pass\ndef plan(after): pass\ndef __eq__(a, other): 1"
    )
    names = [name for _, name in vague_parameters(tree, ["plan"])]
    assert names == ["f(before)", "f(drop)", "f(rest)", "f(more)"]


@pytest.mark.parametrize("part", PARTS)
def test_functions_and_constants_have_a_noun(part: str) -> None:
    bad = nameless(part)
    assert not bad, "\n".join(["name the value with a noun, and a limit as MAX_ or MIN_:", *bad])


def test_a_constant_has_a_single_value() -> None:
    values: dict[str, dict[str, list[str]]] = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        for line, name, value in constants(tree_of(file)):
            place = f"{file.relative_to(PACKAGE.parent)}:{line}"
            if not name.startswith("_"):
                values.setdefault(name, {}).setdefault(value, []).append(place)
    bad = [f"{name}: {places}" for name, places in values.items() if len(places) > 1]
    assert not bad, "\n".join(["a constant of another value has another name:", *bad])


MAX_NUMERIC_CONSTANTS = {"adjustment": 139, "calibration": 24, "diagnosis": 88, "physics/laws": 43, "measurands": 14}
"""Largest number of numeric constants in packages that estimate: limits of one meaning have one owner
(`core/rounding.py`, `core/arrays.py`, `solve/gauss_newton.py`, `adjustment/significance.py`)."""


def holds_a_number(value: ast.AST) -> bool:
    """True if an expression holds a number, apart from indices: `LIMIT[1:]` and `LIMIT` itself are derived."""
    if isinstance(value, ast.Subscript):
        return holds_a_number(value.value)
    if isinstance(value, ast.Constant):
        return isinstance(value.value, int | float) and not isinstance(value.value, bool)
    return any(holds_a_number(part) for part in ast.iter_child_nodes(value))


def numeric_constants(tree: ast.Module) -> list[str]:
    """Names of the constants of a module whose value holds a number; dictionaries, slices and tables are none."""
    parsed = ((name, ast.parse(value, mode="eval").body) for _, name, value in constants(tree))
    tables = ("Table", "slice")
    return [
        name
        for name, value in parsed
        if not isinstance(value, ast.Dict | ast.DictComp)
        and not (isinstance(value, ast.Call) and ast.unparse(value.func) in tables)
        and holds_a_number(value)
    ]


@pytest.mark.parametrize("part", MAX_NUMERIC_CONSTANTS)
def test_the_number_of_numeric_constants_does_not_grow(part: str) -> None:
    names = [
        f"{file.relative_to(PACKAGE.parent)}: {name}"
        for file in sorted((PACKAGE / part).rglob("*.py"))
        for name in numeric_constants(tree_of(file))
    ]
    assert len(names) <= MAX_NUMERIC_CONSTANTS[part], "\n".join(
        [f"{len(names)}: derive a further constant, or use the one of its owner", *names]
    )


def test_numeric_constants_are_those_with_a_literal_number() -> None:
    tree = ast.parse(
        'A = 3\nB: float = 1e-3 * A\nC, D = (2, 4), A[1:]\nE = {"a": 1}\nF = Table("t", 4)\nG = -np.log(A)\nh = 4'
    )
    assert numeric_constants(tree) == ["A", "B", "C"]


@pytest.mark.parametrize("name", ["_judged", "drawn", "_whole", "swept", "silent", "AT_ONCE", "_of_face", "among"])
def test_a_name_without_noun_is_an_offence(name: str) -> None:
    assert is_without_noun(name)


@pytest.mark.parametrize("name", ["seed", "is_drawn", "draw_places", "with_rows", "by_name", "MAX_NAMES", "run_check"])
def test_a_name_with_noun_or_verb_is_none(name: str) -> None:
    assert not is_without_noun(name)


def test_a_limit_says_what_it_limits() -> None:
    tree = ast.parse("MOST_OPTIMA, LEAST = 3, 0.1\n_MANY = 3\nMAX_NAMES: int = 4\nlower = MOST_OPTIMA\n")
    assert [(name, value) for _, name, value in constants(tree)] == [
        ("MOST_OPTIMA", "3"), ("LEAST", "0.1"), ("_MANY", "3"), ("MAX_NAMES", "4"),
    ]  # fmt: skip
    assert [name for _, name, _ in constants(tree) if lacks_decision(name)] == ["MOST_OPTIMA", "LEAST", "_MANY"]


@pytest.mark.parametrize("part", [*PARTS, *CHECKOUT_FOLDERS])
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
    assert not words_of("unknown_name_error") & WORDS and not words_of("foundation") & WORDS
