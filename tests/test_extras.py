"""What only some need is an extra: without it the rest works, and a sentence says what to install."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from ltsim.cli.main import run
from ltsim.scene.meshes import Obstacles, box_triangles, cylinder_triangles, rotate_and_shift_triangles

HEAVY = ("pyvista", "vtkmodules", "trame_vtk", "embreex", "cascadio", "duckdb", "numba", "pyarrow")


@pytest.fixture
def plain_install(monkeypatch):
    """As `pip install ltsim` leaves it."""
    for name in [n for n in sys.modules if n.partition(".")[0] in HEAVY]:
        monkeypatch.delitem(sys.modules, name)
    for name in HEAVY:
        monkeypatch.setitem(sys.modules, name, None)


def test_the_main_verbs_need_no_extra(plain_install, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for line in (
        "simulate paper-workshop --out rec",
        "calibrate rec --out cal",
        "report cal --quiet",
    ):
        assert run(line.split()) == 0, capsys.readouterr().err
    assert "3D views need the extra" in (tmp_path / "cal" / "report.html").read_text()
    for line, extra in (("view rec --html v.html", "view"), ("campaign x.toml", "campaigns")):
        assert run(line.split()) == 2
        assert f"need the extra '{extra}': pip install \"ltsim[{extra}]\"" in capsys.readouterr().err


def test_a_plain_install_asks_for_none_of_them_and_every_extra_is_explained():
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    asked = {re.split(r"[<>=\[]", text)[0].replace("-", "_") for text in project["dependencies"]}
    assert not asked & {*HEAVY, "openpyxl", "pandas", "xarray", "dask"}
    explained = re.findall(r"^\| `(\w+)` \|", (root / "docs" / "install.md").read_text(), re.MULTILINE)
    assert sorted(explained) == sorted(project["optional-dependencies"])


def test_a_cad_file_needs_no_extra(plain_install, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    corners = [f"v {x} {y} {z}" for x in (2500, 3500) for y in (2500, 3500) for z in (0, 2900)]
    faces = ["f 1 3 4 2", "f 5 6 8 7", "f 1 2 6 5", "f 3 7 8 4", "f 1 5 7 3", "f 2 4 8 6"]
    Path("machine.obj").write_text("\n".join(corners + faces))
    Path("hall.toml").write_text('base = "paper-workshop"\n[[workshop.obstacles]]\nname = "m"\nfile = "machine.obj"\n')
    assert run(["simulate", "hall.toml", "--out", "rec"]) in (0, 2)
    assert "inside an obstacle" in capsys.readouterr().err  # S1 stands in the machine


def test_obstacles_hide_without_embree_what_they_hide_with_it(plain_install):
    bodies = [
        box_triangles(np.array([1.0, 2.0, 3.0])),
        rotate_and_shift_triangles(cylinder_triangles(1.0, 2.0), np.array([3.0, 0.0, 0.0]), 0.3),
    ]
    obstacles = Obstacles(np.concatenate(bodies))
    rng = np.random.default_rng(2)
    origins, ends = rng.uniform(-5, 5, (2, 300, 3))
    blocked = obstacles.is_blocked(origins, ends)
    assert 5 < blocked.sum() < 150
    inside = obstacles.is_inside_body(np.array([[0.4, 0.9, 2.9], [0.6, 0.0, 1.0], [3.4, 0.0, 1.0], [3.6, 0.0, 1.0]]))
    assert inside.tolist() == [True, False, True, False]


@pytest.mark.long
def test_pictures_do_without_the_packages_of_campaigns() -> None:
    missing = "import sys; sys.modules.update(dict.fromkeys(('duckdb', 'numba', 'pyarrow')))"
    without = f"{missing}; import ltsim.reports.plots"
    subprocess.run([sys.executable, "-c", without], check=True)
