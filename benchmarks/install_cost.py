"""Table of docs/install.md: size, load time and task of each dependency.

    python -m benchmarks.install_cost

`whole` is the size of a package with all its dependencies. `freed` is the disk space that its removal would free; it
is smaller, because packages share dependencies. The load time is the processor time of the import in a new process,
without the start of the interpreter, smallest of three measurements. Nothing is downloaded.
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
    "numpy": "arrays, used by all packages of ltsim",
    "scipy": "factorisations, sparse matrices, rotations, distributions, root finding",
    "pyvista": "3D view and pictures of the hall (with VTK)",
    "trame-vtk": "page with the 3D view, which works offline",
    "trimesh": "CAD files with triangle meshes (STL, OBJ, PLY, glTF)",
    "embreex": "fast tests whether obstacles block lines of sight",
    "shapely": "polygons of the floor in a plan",
    "tomlkit": "TOML files with comments and layout for people",
    "filelock": "lock of a campaign folder against a second campaign, on every operating system",
    "joblib": "several processes in campaigns, recovery and plans",
    "matplotlib": "figures of reports",
    "typer": "command line with help and completion",
    "rich": "progress bars on a terminal",
    "pydantic": "validation of input and result files, with error messages",
    "pyarrow": "result rows of campaigns in Parquet files",
    "duckdb": "queries of millions of result rows in limited memory",
    "jinja2": "HTML of reports, with special characters escaped",
    "threadpoolctl": "one thread per process when several processes run",
    "numba": "compiled numerical kernels of campaigns",
    "defusedxml": "safe reading of XML files of other programs (gama-local, OpenIndy)",
    "pandas": "results as data frames in notebooks",
    "xarray": "campaign results as datasets with axes in notebooks",
    "openpyxl": "readings from Excel workbooks",
    "dask": "campaigns on a cluster",
    "distributed": "campaigns on a cluster",
    "cascadio": "STEP and IGES files as obstacles",
}
MODULE = {"trame-vtk": "trame_vtk.modules.vtk.serializers", "scipy": "scipy.stats", "matplotlib": "matplotlib.figure"}
"""Imported module of each package whose module has another name, as ltsim imports it."""
CLOCK = "import resource as r; u = r.getrusage(r.RUSAGE_SELF); print(u.ru_utime + u.ru_stime)"


def required_packages() -> dict[str, str]:
    """Extra ('' for none) by name of each package that ltsim requires, without tools for developers."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    texts_by_extra = {"": project["dependencies"], **project["optional-dependencies"]}
    required = [(Requirement(text).name, extra) for extra, texts in texts_by_extra.items() for text in texts]
    return {name: extra for name, extra in reversed(required) if extra not in ("dev", "docs") and name != "ltsim"}


def needs(name: str, cache: dict[str, set[str]]) -> set[str]:
    """Names of a package and of all its installed dependencies."""
    key = re.sub(r"[-_.]+", "-", name).lower()
    if key in cache:
        return cache[key]
    cache[key] = set()  # packages may need each other in a circle
    try:
        listed = distribution(key).requires or []
    except PackageNotFoundError:
        return set()
    wanted = [Requirement(text) for text in listed]
    inner = [r.name for r in wanted if r.marker is None or r.marker.evaluate({"extra": ""})]
    cache[key] = {key}.union(*(needs(other, cache) for other in inner))
    return cache[key]


def megabytes(name: str) -> float:
    """Size of a package's own files [MB], without compiled bytecode."""
    package: Distribution = distribution(name)
    files = (Path(str(package.locate_file(file))) for file in package.files or [] if file.suffix != ".pyc")
    return sum(file.stat().st_size for file in files if file.is_file()) / 1e6


def seconds(module: str) -> float:
    """Processor time [s] of importing a module, without the start of the interpreter."""
    return max(0.0, min(_clock(f"import {module}; ") for _ in range(3)) - min(_clock("") for _ in range(3)))


def _clock(statement: str) -> float:
    done = subprocess.run([sys.executable, "-c", statement + CLOCK], capture_output=True, text=True, check=True)
    return float(done.stdout)


def rows() -> list[list[str]]:
    """Row of each package: name, version, extra, whole size [MB], freed size [MB], load time [s], task in ltsim."""
    packages, cache = required_packages(), dict[str, set[str]]()
    closure = {name: needs(name, cache) for name in packages}
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
    header = ["package", "version", "extra", "whole [MB]", "freed [MB]", "loads in [s]", "task in ltsim"]
    lines = [header, ["---"] * len(header), *sorted(rows(), key=lambda row: -float(row[4] or -1))]
    text = "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
