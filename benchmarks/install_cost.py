"""What each dependency costs to install and to load, beside what it saves: the table of docs/install.md.

    python -m benchmarks.install_cost

`whole` is the size of a package with all that it needs itself; `freed` is what would go if ltsim did without it, since
packages share what they need. Seconds are processor time of loading it in a process of its own, the interpreter's own
start taken off, least of three; nothing is downloaded.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
SAVES = {
    "numpy": "arrays: everything rests on it",
    "scipy": "factorisations, sparse matrices, rotations, distributions, root finding",
    "pyvista": "the 3D view and the pictures of the workshop (vtk)",
    "trame-vtk": "the page with the 3D view that opens offline",
    "trimesh": "CAD files in all their formats",
    "embreex": "rays against CAD files and boxes that stand in the way",
    "shapely": "outlines of the floor of a plan",
    "tomlkit": "TOML written as people read it",
    "filelock": "one campaign at a time in a folder, on every system",
    "joblib": "processes: campaigns, recovery, plans",
    "matplotlib": "figures of reports",
    "typer": "the command line, its help and completion",
    "rich": "progress and signs of life on a terminal",
    "pydantic": "settings and result files checked, with a sentence for what is wrong",
    "pyarrow": "rows of campaigns as Parquet",
    "duckdb": "queries over millions of rows in bounded memory",
    "jinja2": "the report, escaped",
    "threadpoolctl": "one thread a process where processes share the work",
    "numba": "the campaigns' compiled kernels",
    "defusedxml": "XML from strangers (gama-local, OpenIndy)",
    "pandas": "results as data frames in notebooks",
    "xarray": "sweeps as datasets with axes in notebooks",
    "openpyxl": "readings from workbooks",
    "dask": "campaigns on a cluster",
    "distributed": "campaigns on a cluster",
    "cascadio": "STEP and IGES files as obstacles",
}
MODULE = {"trame-vtk": "trame_vtk.modules.vtk.serializers", "scipy": "scipy.stats", "matplotlib": "matplotlib.figure"}
"""What is loaded, where it is not the name itself: as ltsim loads it."""
CLOCK = "import resource as r; u = r.getrusage(r.RUSAGE_SELF); print(u.ru_utime + u.ru_stime)"


def declared() -> dict[str, str]:
    """Packages that ltsim asks for, each with the extra that asks for it ('' for none); tools of developers aside."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = {"": project["dependencies"], **project["optional-dependencies"]}
    wanted = [(Requirement(text).name, kind) for kind, texts in asked.items() for text in texts]
    return {name: kind for name, kind in reversed(wanted) if kind not in ("dev", "docs") and name != "ltsim"}


def needs(name: str, known: dict[str, set[str]]) -> set[str]:
    """A package and all that it needs, as far as it is installed."""
    key = re.sub(r"[-_.]+", "-", name).lower()
    if key in known:
        return known[key]
    known[key] = set()  # packages may need each other in a circle
    try:
        listed = distribution(key).requires or []
    except PackageNotFoundError:
        return set()
    wanted = [Requirement(text) for text in listed]
    inner = [r.name for r in wanted if r.marker is None or r.marker.evaluate({"extra": ""})]
    known[key] = {key}.union(*(needs(other, known) for other in inner))
    return known[key]


def megabytes(name: str) -> float:
    """Size of a package's own files [MB]; compiled bytecode is made later and left out."""
    package: Distribution = distribution(name)
    files = (Path(str(package.locate_file(file))) for file in package.files or [] if file.suffix != ".pyc")
    return sum(file.stat().st_size for file in files if file.is_file()) / 1e6


def seconds(module: str) -> float:
    """Processor time [s] of loading a module, the interpreter's start taken off."""
    return max(0.0, min(_clock(f"import {module}; ") for _ in range(3)) - min(_clock("") for _ in range(3)))


def _clock(before: str) -> float:
    done = subprocess.run([sys.executable, "-c", before + CLOCK], capture_output=True, text=True, check=True)
    return float(done.stdout)


def rows() -> list[list[str]]:
    """One row a package: name, extra, MB with what it needs, MB freed without it, seconds, what it saves."""
    packages, known = declared(), dict[str, set[str]]()
    closure = {name: needs(name, known) for name in packages}
    size = {name: megabytes(name) for name in set().union(*closure.values())}
    table = []
    for name, extra in packages.items():
        if not closure[name]:
            continue  # an extra that is not installed here
        others = set().union(*(closure[other] for other, kind in packages.items() if other != name and not kind))
        whole, freed = sum(size[n] for n in closure[name]), sum(size[n] for n in closure[name] - others)
        loaded = seconds(MODULE.get(name, name.replace("-", "_")))
        table.append([name, version(name), extra, f"{whole:.0f}", f"{freed:.0f}", f"{loaded:.2f}", SAVES.get(name, "")])
    plain = set().union(*(closure[name] for name, extra in packages.items() if not extra))
    for title, extras in (("**all without an extra**", ()), ('**with the extra "campaigns"**', ("campaigns",))):
        held = plain.union(*(closure[name] for name, extra in packages.items() if extra in extras))
        table.append([title, "", "", f"{sum(size[n] for n in held):.0f}", "", "", ""])
    return table


def main() -> None:
    """Print the table."""
    header = ["package", "version", "extra", "whole [MB]", "freed [MB]", "loads in [s]", "what it saves"]
    lines = [header, ["---"] * len(header), *sorted(rows(), key=lambda row: -float(row[4] or -1))]
    text = "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
