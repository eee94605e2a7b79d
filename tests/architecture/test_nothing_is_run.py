"""No file can run anything: the code holds no call that turns what a file says into code, but for those listed here."""

from __future__ import annotations

import ast
import json
import os
import pickle
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import ltsim
import ltsim as lt
from ltsim.core.errors import LtsimError

PACKAGE = Path(ltsim.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

MODULES_THAT_RUN = {
    *("pickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "yaml", "runpy", "code", "codeop", "imp"),
    *("ctypes", "cffi", "tarfile", "xmlrpc", "xml.sax", "xml.dom", "lxml"),
}
"""Libraries that make code or objects of bytes, unpack to places that an archive names, or follow references of XML."""
BUILTINS_THAT_RUN = {"eval", "exec", "compile", "__import__"}
CALLS_THAT_RUN = {
    *("import_module", "spec_from_file_location", "exec_module", "find_loader", "literal_eval", "from_string"),
    *("extract", "extractall", "unpack_archive", "read_pickle", "iterparse", "fromstring"),
    *("__reduce__", "__reduce_ex__", "__setstate__"),
}
"""Names of functions that import, unpack or build what their argument says."""
PROCESSES = re.compile(r"(subprocess\.\w+|os\.(system|popen|exec\w+|spawn\w+|posix_spawn\w*|startfile))")
"""Functions that start a program."""
ALLOWED = {
    "ltsim/__init__.py": {"import_module": "modules of the package by the table of its public names"},
    "ltsim/recordings/__init__.py": {"import_module": "modules of the package by the table of its public names"},
    "ltsim/physics/effects/__init__.py": {"import_module": "the effects that ship, by the table in the same file"},
    "ltsim/reports/sections/__init__.py": {"import_module": "the sections of a page, by the table in the same file"},
    "ltsim/reports/figures/__init__.py": {"import_module": "the figures, by the name of an attribute in code"},
    "ltsim/cli/main.py": {"import_module": "the verbs, by the table in the same file"},
    "ltsim/campaigns/external_calibrator.py": {
        "run": "the program that the user names as --calibrator; no file can name it"
    },
    "ltsim/campaigns/campaign.py": {"run": "`git rev-parse HEAD`, fixed words, in the folder of the package"},
    "ltsim/scene/cad_process.py": {"run": "this interpreter with a fixed program; a file's path is an argument"},
    "ltsim/core/equality.py": {"__reduce__": "parts of an object in memory, to compare them"},
}
"""Calls of these names with the reason why no file decides what they do."""


def named(path: Path) -> str:
    return path.relative_to(PACKAGE.parent).as_posix()


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def called(node: ast.Call) -> str:
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def is_dangerous(node: ast.Call) -> bool:
    is_builtin = isinstance(node.func, ast.Name) and node.func.id in BUILTINS_THAT_RUN
    return is_builtin or called(node) in CALLS_THAT_RUN or PROCESSES.fullmatch(ast.unparse(node.func)) is not None


def imports_danger(node: ast.ImportFrom) -> bool:
    module = node.module or ""
    starts = any(PROCESSES.fullmatch(f"{module}.{alias.name}") for alias in node.names)
    return starts or bool({module, module.split(".")[0]} & MODULES_THAT_RUN)


def dangers(source: ast.Module) -> set[str]:
    """Names of calls and imports in a module that could run what a file says."""
    names = set()
    for node in ast.walk(source):
        if isinstance(node, ast.Import):
            names |= {a.name for a in node.names if {a.name, a.name.split(".")[0]} & MODULES_THAT_RUN}
        elif isinstance(node, ast.ImportFrom) and imports_danger(node):
            names.add(str(node.module))
        elif isinstance(node, ast.Call) and is_dangerous(node):
            names.add(called(node))
        elif (
            isinstance(node, ast.keyword)
            and node.arg in ("allow_pickle", "shell")
            and ast.unparse(node.value) != "False"
        ):
            names.add(f"{node.arg}=")
    return names


def test_no_module_runs_what_a_file_names() -> None:
    names_by_module = {named(path): dangers(tree(path)) - ALLOWED.get(named(path), {}).keys() for path in MODULES}
    assert {file: names for file, names in names_by_module.items() if names} == {}, (
        "say in ALLOWED why no file decides what it does"
    )


def test_the_list_of_exceptions_is_no_longer_than_needed() -> None:
    assert {file: set(names) - dangers(tree(PACKAGE.parent / file)) for file, names in ALLOWED.items()} == {
        file: set() for file in ALLOWED
    }


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from pickle import loads",
        "eval(text)",
        "np.load(path, allow_pickle=True)",
        "np.load(path, allow_pickle=says)",
        "importlib.import_module(name)",
        "archive.extractall(folder)",
        "subprocess.run(words)",
        "from os import system",
        "environment.from_string(text)",
    ],
)
def test_the_search_finds_what_it_is_for(text: str) -> None:
    assert dangers(ast.parse(text))


@pytest.mark.parametrize("path", [p for p in MODULES if "recording" in p.parts or p.name == "files.py"], ids=named)
def test_readers_take_no_attribute_whose_name_a_file_gives(path: Path) -> None:
    """An attribute of a reader is a word in the code, or a variable that runs over words in the code."""
    allowed = {
        "ltsim/recordings/__init__.py": {"_MODULE_BY_NAME[name]", "name"},  # public names of the package
        "ltsim/recordings/pointings.py": {"kind"},  # ("station", "target")
        "ltsim/recordings/settings.py": {"kind"},  # ("stations", "targets", "reflectors")
        "ltsim/recordings/formats/polar_text.py": {"name"},  # names of hints, keys of a table in the same file
        "ltsim/recordings/formats/cern_declarations.py": {"kind"},  # names of fields of the same class
        "ltsim/calibration/files.py": {"name"},  # fields of the model
    }
    names = {
        ast.unparse(node.args[1])
        for node in ast.walk(tree(path))
        if isinstance(node, ast.Call) and called(node) in ("getattr", "setattr", "__getattribute__")
        if len(node.args) > 1 and not isinstance(node.args[1], ast.Constant)
    }
    assert names <= allowed.get(named(path), set())


class Marker:
    """An object whose pickle makes a folder when it is loaded."""

    def __init__(self, place: Path) -> None:
        self.place = str(place)

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (self.place,)


@pytest.mark.parametrize(
    "suffix", [".lt", ".json", ".csv", ".xlsx", ".toml", ".pkl", ".npy", ".txt", ".xml", ".zip", ""]
)
@pytest.mark.parametrize("kind", ["pickle", "archive", "tree"])
def test_reading_a_file_that_names_code_runs_none(kind: str, suffix: str, tmp_path: Path) -> None:
    file, made = tmp_path / f"file{suffix}", tmp_path / "made"
    if kind == "pickle":
        file.write_bytes(pickle.dumps(Marker(made), protocol=0))
    else:
        item = {"is": "made", "no": 0, "class": "os:mkdir", "of": [str(made)], "format": "ltsim-result/1"}
        item |= {"py/reduce": ["os.mkdir", [str(made)]], "__reduce__": ["os.mkdir", [str(made)]]}
        text = json.dumps({**item, "result": item})
        if kind == "tree":
            file.write_text(text)
        else:
            with zipfile.ZipFile(file, "w") as archive:
                archive.writestr("result.json", text)
                archive.writestr("0.npy", pickle.dumps(Marker(made)))
                archive.writestr("../made", "")
    with pytest.raises(LtsimError) as caught:
        lt.read(file)
    assert "\n" not in str(caught.value)
    assert not made.exists()


SPY = "import os, sys; open(os.environ['MARK'], 'a').write(__file__ + chr(10))\n"
WORK = """
from ltsim.core.parallel import run_parallel
if __name__ == "__main__":
    print(list(run_parallel(round, ((1.4,), (2.6,), (3.2,)), 2)))
"""


def test_a_working_folder_that_holds_modules_runs_none(tmp_path: Path) -> None:
    """Neither this process nor its workers take a module from the folder that they stand in."""
    here, mark = tmp_path / "here", tmp_path / "mark"
    here.mkdir()
    for name in ("numpy", "joblib", "scipy", "numba", "sitecustomize", "ltsim"):
        (here / f"{name}.py").write_text(SPY)
    (tmp_path / "work.py").write_text(WORK)
    environment = {**os.environ, "MARK": str(mark)}
    done = subprocess.run(
        [sys.executable, str(tmp_path / "work.py")],
        cwd=here, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout == "[1, 3, 3]\n", done.stderr
    assert not mark.exists(), mark.read_text()


SETTINGS = {
    "matplotlibrc": (b"axes.titlesize: 77\n", b"axes.titlesize: \xe9\xff\n", b""),
    ".numba_config.yaml": (b"cache_dir: /tmp/cache\n", b"- a: [", b""),
}
"""Files of settings in a working folder that libraries read: usable, broken, and a pipe (empty)."""
IMPORTS = """
import ltsim.reports.style, ltsim.campaigns.compilation, matplotlib, numba, os
numba.core.config.reload_config()
print(matplotlib.rcParams["axes.titlesize"], repr(numba.config.CACHE_DIR), os.getcwd())
"""


@pytest.mark.parametrize("kind", range(3), ids=["usable", "broken", "pipe"])
def test_settings_of_libraries_in_a_working_folder_are_not_read(kind: int, tmp_path: Path) -> None:
    """Numba unpickles code of a folder that its settings name; a broken file ended in status 70, a pipe was awaited."""
    pytest.importorskip("numba", reason="kernels need the extra 'campaigns'")
    for name, contents in SETTINGS.items():
        if contents[kind]:
            (tmp_path / name).write_bytes(contents[kind])
        else:
            os.mkfifo(tmp_path / name)
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "MPLCONFIGDIR")}
    done = subprocess.run(
        [sys.executable, "-P", "-c", IMPORTS],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.stdout == f"large '' {tmp_path}\n", done.stderr
