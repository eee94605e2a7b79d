"""CAD of exact surfaces: read in its own unit where the library is there, one sentence where it is not."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from ltsim.errors import SetupError
from ltsim.scene.meshes import read_mesh

CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
HEADER = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('box','',(''),(''),'','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN'));
ENDSEC;
DATA;
"""


def step_box(size: tuple[float, float, float], unit: str) -> str:
    """A box with a corner at the origin, as a faceted boundary representation in ISO 10303-21."""
    lines: list[str] = []

    def add(text: str) -> str:
        lines.append(f"#{len(lines) + 1}={text};")
        return f"#{len(lines)}"

    def triple(values: np.ndarray) -> str:
        return "(" + ",".join(f"{v:.6f}" for v in values) + ")"

    places = np.array(CORNERS) * size
    corner = [add(f"CARTESIAN_POINT('',{triple(p)})") for p in places]
    faces = []
    for face in FACES:
        a, b, c = places[list(face[:3])]
        across, out = (b - a) / np.linalg.norm(b - a), np.cross(b - a, c - b)
        loop = add(f"POLY_LOOP('',({','.join(corner[i] for i in face)}))")
        bound = add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        axes = [add(f"DIRECTION('',{triple(v)})") for v in (out / np.linalg.norm(out), across)]
        where = add(f"AXIS2_PLACEMENT_3D('',{corner[face[0]]},{axes[0]},{axes[1]})")
        plane = add(f"PLANE('',{where})")
        faces.append(add(f"FACE_SURFACE('',({bound}),{plane},.T.)"))
    shell = add(f"CLOSED_SHELL('',({','.join(faces)}))")
    body = add(f"FACETED_BREP('box',{shell})")
    metre = add(f"(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT({unit},.METRE.))")
    radian = add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    solid = add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    context = add(
        f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNIT_ASSIGNED_CONTEXT(({metre},{radian},{solid}))"
        "REPRESENTATION_CONTEXT('',''))"
    )
    shape = add(f"FACETED_BREP_SHAPE_REPRESENTATION('',({body}),{context})")
    use = add("APPLICATION_CONTEXT('automotive_design')")
    field = add(f"PRODUCT_CONTEXT('',{use},'mechanical')")
    product = add(f"PRODUCT('box','box','',({field}))")
    formation = add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    stage = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{use},'design')")
    made = add(f"PRODUCT_DEFINITION('','',{formation},{stage})")
    form = add(f"PRODUCT_DEFINITION_SHAPE('','',{made})")
    add(f"SHAPE_DEFINITION_REPRESENTATION({form},{shape})")
    return HEADER + "\n".join(lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"


@pytest.mark.parametrize(("unit", "size"), [(".MILLI.", (2500, 1500, 2200)), ("$", (2.5, 1.5, 2.2))])
def test_a_step_file_is_read_in_its_own_unit(unit: str, size: tuple[float, float, float], tmp_path: Path) -> None:
    pytest.importorskip("cascadio", reason="the extra step is not installed")
    file = tmp_path / "box.step"
    file.write_text(step_box(size, unit))
    triangles = read_mesh(file, "mm")
    assert triangles.min(axis=(0, 1)) == pytest.approx([0, 0, 0], abs=1e-6)
    assert triangles.max(axis=(0, 1)) == pytest.approx([2.5, 1.5, 2.2], abs=1e-6)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert 0.5 * np.linalg.norm(cross, axis=1).sum() == pytest.approx(2 * (2.5 * 1.5 + 2.5 * 2.2 + 1.5 * 2.2), rel=1e-5)


@pytest.mark.parametrize("suffix", [".step", ".stp", ".igs", ".iges"])
def test_a_damaged_file_is_one_sentence_and_nothing_else(suffix: str, tmp_path: Path, capfd) -> None:
    pytest.importorskip("cascadio", reason="the extra step is not installed")
    file = tmp_path / f"bad{suffix}"
    file.write_text(HEADER + "#1=NONSENSE(;\n")
    with pytest.raises(SetupError, match=rf"bad\{suffix}: is not a whole"):
        read_mesh(file, "mm")
    assert capfd.readouterr() == ("", "")


def test_without_the_library_the_sentence_says_what_to_install(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "cascadio", None)
    file = tmp_path / "machine.step"
    file.write_text("ISO-10303-21;")
    with pytest.raises(SetupError, match=r'machine.step: .*pip install "ltsim\[step\]", or export it .* as STL'):
        read_mesh(file, "mm")
