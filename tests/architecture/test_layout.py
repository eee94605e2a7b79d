"""What style and layout promise and no other tool checks."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

import ltsim
from ltsim import effects
from ltsim.physics.effects.effect import Effect
from tests.architecture.syntax import tree_of

PACKAGE = Path(ltsim.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
LARGEST = 400
CONTRACT = {"__init__", "effect"}


def named(path: Path) -> str:
    return path.relative_to(PACKAGE.parent).as_posix()


def effects_in(module: str) -> list[type[Effect]]:
    """The effects a file of the room defines: classes of its own that carry a name."""
    loaded = importlib.import_module(f"ltsim.physics.effects.{module}")
    classes = inspect.getmembers(loaded, inspect.isclass)
    return [
        cls
        for _, cls in classes
        if issubclass(cls, Effect) and cls.__module__ == loaded.__name__ and isinstance(cls.name, str)
    ]


@pytest.mark.parametrize("module", [m.name for m in pkgutil.iter_modules(effects.__path__) if m.name not in CONTRACT])
def test_every_effect_file_is_in_the_catalogue(module: str) -> None:
    catalogue = {entry if isinstance(entry, type) else type(entry) for entry in effects.CATALOGUE}
    missing = [cls.__name__ for cls in effects_in(module) if cls not in catalogue]
    assert not missing, f"ltsim/physics/effects/{module}.py: add {', '.join(missing)} to GROUPS"
    assert len(effects_in(module)) <= 1, f"ltsim/physics/effects/{module}.py: one file, one effect"


def test_catalogue_names_each_effect_once() -> None:
    names = [entry.name for entry in effects.CATALOGUE]
    assert len(names) == len(set(names))


def test_a_value_given_to_a_cached_property_has_its_name() -> None:
    """A value under another name in the dictionary of an object would never be used."""
    nodes = [node for path in MODULES for node in ast.walk(tree_of(path))]
    cached = {
        n.name
        for n in nodes
        if isinstance(n, ast.FunctionDef) and any("cached_property" in ast.unparse(d) for d in n.decorator_list)
    }
    given = {
        target.slice.value
        for node in nodes
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Subscript)
        and isinstance(target.slice, ast.Constant)
        and ast.unparse(target.value).startswith("vars(")
    }
    assert given and given <= cached


def test_modules_are_small_enough_to_read() -> None:
    """All modules in one test: a test per module takes longer to distribute than to run."""
    lengths = {named(path): len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES}
    too_long = [f"{name} has {lines} lines: divide it" for name, lines in lengths.items() if lines > LARGEST]
    assert len(lengths) > 400 and too_long == []


def test_only_the_command_line_prints() -> None:
    prints = [
        f"{named(path)}, line {node.lineno}"
        for path in MODULES
        if path.parent != PACKAGE / "cli"
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert prints == []


def test_the_map_of_the_contributors_is_true(root: Path) -> None:
    """Files that contributing.md names exist, and define what it says; each module in its lists is one."""
    text = (root / "docs" / "contributing.md").read_text()
    paths = re.findall(r"`((?:ltsim|tests|docs)/[\w./-]+)`", text)
    assert len(paths) > 25 and not [path for path in paths if not (root / path).exists()]
    defined = re.findall(r"`(\w+)` in `(ltsim/[\w./]+\.py)`", text)
    assert {"evaluate_plan", "MeasurementModel"} <= {name for name, _ in defined}
    assert not [
        name
        for name, path in defined
        if not re.search(rf"^(?:(?:def|class) )?{name}\b", (root / path).read_text(), re.M)
    ]
    homes = [PACKAGE, *(PACKAGE / name for name in ("adjustment", "diagnosis", "physics"))]
    lists = re.findall(r"^```text\n(.*?)^```", text, re.MULTILINE | re.DOTALL)[1:]
    heads = [re.split(r"\s{2,}", line.strip())[0] for block in lists for line in block.splitlines()]
    for head in heads:
        folder = f"{head.rpartition('/')[0]}/" if "/" in head else ""
        for name in (folder + word.rpartition("/")[2] for word in head.rstrip(",").split(", ")):
            modules = [home / f"{name}.py" for home in homes] + [home / "laws" / f"{name}.py" for home in homes]
            assert any(module.exists() for module in modules), name


def test_there_are_at_most_twelve_floors(root: Path) -> None:
    contracts = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(c["layers"] for c in contracts if c["containers"] == ["ltsim"])
    floors = [layer for layer in layers if layer != "(__main__)"]
    packages = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert len(floors) <= 12 and len(packages) <= 16
    assert {re.sub(r"\W", "", name) for floor in floors for name in floor.split("|")} == {*packages, "api"}


TOP_LEVEL = {
    *(".ci", ".gitignore", "CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md", "SECURITY.md", "benchmarks", "docs"),
    *("experiments", "ltsim", "pyproject.toml", "results", "tests"),
}
"""Files and folders of the repository."""


def test_the_top_level_has_no_further_folder(root: Path) -> None:
    """A folder of results, which a command wrote beside the sources, was committed once."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=True)
    assert {name.split("/")[0] for name in listed.stdout.split("\0") if name} == TOP_LEVEL


def test_every_room_is_a_package() -> None:
    """The layers are checked only in folders with an `__init__.py`."""
    rooms = {path.parent for path in MODULES}
    assert [named(room) for room in rooms if not (room / "__init__.py").exists()] == []


def test_continuous_integration_runs_what_the_readme_says(root: Path) -> None:
    commands = [line for line in (root / ".ci" / "run").read_text().splitlines() if "pytest" in line]
    assert len(commands) == 1
    readme = (root / "README.md").read_text()
    blocks = re.findall(r"^```[^\n]*\n(.*?)^```", readme, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    assert commands[0] in lines, f"README.md does not say: {commands[0]}"
