"""CAD by the convention of its format: the same body from each, and a question where it cannot be meant so."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import ltsim as lt
from ltsim.core.errors import InputError
from ltsim.planning.loading import load_plan
from ltsim.scene.cad import Y_UP_TO_Z_UP, read_cad_file
from ltsim.simulation.workshop import placed_obstacles

HEADER = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('box','',(''),(''),'','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN'));
ENDSEC;
DATA;
"""


def step_of(mesh: trimesh.Trimesh, unit: str) -> str:
    """A closed mesh as a faceted boundary representation in ISO 10303-21."""
    lines: list[str] = []

    def add(text: str) -> str:
        lines.append(f"#{len(lines) + 1}={text};")
        return f"#{len(lines)}"

    def triple(values: np.ndarray) -> str:
        return "(" + ",".join(f"{v:.6f}" for v in values) + ")"

    places = mesh.vertices
    corner = [add(f"CARTESIAN_POINT('',{triple(p)})") for p in places]
    faces = []
    for face in mesh.faces:
        a, b, c = places[face]
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
def test_a_step_file_is_read_in_its_unit(unit: str, size: tuple[float, float, float], tmp_path: Path) -> None:
    pytest.importorskip("cascadio", reason="the extra step is not installed")
    file = tmp_path / "box.step"
    file.write_text(step_of(trimesh.creation.box(bounds=[[0, 0, 0], size]), unit))
    triangles = read_cad_file(file).triangles
    assert triangles.min(axis=(0, 1)) == pytest.approx([0, 0, 0], abs=1e-6)
    assert triangles.max(axis=(0, 1)) == pytest.approx([2.5, 1.5, 2.2], abs=1e-6)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert 0.5 * np.linalg.norm(cross, axis=1).sum() == pytest.approx(2 * (2.5 * 1.5 + 2.5 * 2.2 + 1.5 * 2.2), rel=1e-5)


@pytest.mark.parametrize("suffix", [".step", ".stp", ".igs", ".iges"])
def test_a_damaged_file_is_refused_in_a_sentence_without_further_output(suffix: str, tmp_path: Path, capfd) -> None:
    pytest.importorskip("cascadio", reason="the extra step is not installed")
    file = tmp_path / f"bad{suffix}"
    file.write_text(HEADER + "#1=NONSENSE(;\n")
    with pytest.raises(InputError, match=rf"bad\{suffix}: the file is not a complete"):
        read_cad_file(file)
    assert capfd.readouterr() == ("", "")


def test_a_gltf_in_several_files_is_refused_in_a_sentence(tmp_path: Path) -> None:
    for name, content in trimesh.creation.box().export(file_type="gltf").items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"gltf: the file stores .* in other files \(.*bin\); export it as .glb"):
        read_cad_file(tmp_path / "model.gltf")


def test_without_the_library_the_sentence_says_what_to_install(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "cascadio", None)
    file = tmp_path / "machine.step"
    file.write_text("ISO-10303-21;")
    with pytest.raises(InputError, match=r'machine.step: .*pip install "ltsim\[step\]", or export it .* as STL'):
        read_cad_file(file)


HALL = """format = "ltsim-plan/1"
points = "points.csv"
[workshop]
size_mm = [40000, 25000, 12000]
[[workshop.obstacles]]
name = "fuselage"
file = "FILE"
position_mm = [0, 0, 0]
[instrument]
preset = "modern"
[instrument.limits]
range_max_mm = 40000
[stations]
count = 3
min_stations_per_target = 1
[search]
starts = 1
grid_step_mm = 8000
yaw_count = 1
height_count = 1
"""
POINTS = [
    f"P{i}{k},{x},{y},{z}"
    for i, x in enumerate((8000, 17000, 26000, 33000))
    for k, (y, z) in enumerate(((10000, 4000), (15000, 4500), (12500, 6600)))
]


def fuselage() -> trimesh.Trimesh:
    """A body of 30 m along x whose tail is raised, in a hall's metres, z up."""
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = np.stack([np.zeros(12), 2 * np.cos(turn), 2 * np.sin(turn)], axis=1)
    places = [ring + [-12, 0, 0], ring + [8, 0, 0], [[-15, 0, -1.0]], [[15, 0, 1.9]]]
    return trimesh.convex.convex_hull(np.concatenate(places) + [20.0, 12.5, 4.0])


def written(folder: Path, name: str, turn: np.ndarray = Y_UP_TO_Z_UP.T, **keys: str) -> Path:
    """A plan whose fuselage is the file `name`, in the convention of its format; OBJ in another order."""
    mesh, file = fuselage(), folder / name
    if file.suffix == ".obj":
        mesh = trimesh.Trimesh(mesh.vertices[::-1], np.roll(len(mesh.vertices) - 1 - mesh.faces[::-1], 1, axis=1))
    if file.suffix in (".glb", ".gltf"):
        mesh = trimesh.Trimesh(mesh.vertices @ turn.T, mesh.faces)
    else:
        mesh.apply_scale(1000.0)
    if file.suffix == ".step":
        file.write_text(step_of(mesh, ".MILLI."))
    elif file.suffix == ".gltf":
        file.write_bytes(mesh.export(file_type="gltf", merge_buffers=True, embed_buffers=True)["model.gltf"])
    else:
        mesh.export(file)
    text = "".join(f'{key} = "{value}"\n' for key, value in keys.items())
    (folder / "points.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *POINTS]))
    plan = folder / "plan.toml"
    plan.write_text(HALL.replace('"FILE"\n', f'"{name}"\n{text}'))
    return plan


def test_a_body_of_a_file_hides_sights(tmp_path: Path) -> None:
    survey = lt.plan(written(tmp_path, "fuselage.stl")).network.layout.survey
    assert survey.is_visible.any() and not survey.is_visible.all()


@pytest.mark.parametrize(
    ("name", "turn", "keys"),
    [
        ("fuselage.obj", Y_UP_TO_Z_UP.T, {}),
        ("fuselage.glb", Y_UP_TO_Z_UP.T, {}),
        ("fuselage.gltf", Y_UP_TO_Z_UP.T, {}),
        ("fuselage.glb", np.eye(3), {"up": "z"}),
        ("fuselage.step", Y_UP_TO_Z_UP.T, {}),
    ],
)
def test_each_format_gives_the_same_body(name: str, turn: np.ndarray, keys: dict[str, str], tmp_path: Path) -> None:
    """A convex body is that of its corners."""
    if name.endswith("step"):
        pytest.importorskip("cascadio", reason="the extra step is not installed")
    (body,) = placed_obstacles(load_plan(written(tmp_path, name, turn, **keys))[1])
    corners = [np.unique(t.reshape(-1, 3).round(5) + 0.0, axis=0) for t in (body.triangles, fuselage().triangles)]
    assert corners[0] == pytest.approx(corners[1], abs=2e-5)
    assert "30 x 4 x 4 m, x 5.00 to 35.00" in body.description


PLACE = "position_mm = [0, 0, 0]"


@pytest.mark.parametrize(
    ("name", "turn", "scale", "place", "sentence"),
    [
        ("fuselage.stl", None, 1e-3, PLACE, 'does not declare; set unit = "m", or unit = "mm" if this is correct'),
        ("fuselage.stl", None, 1 / 25.4, PLACE, 'does not declare; set unit = "in", or unit = "mm" if this is correct'),
        ("fuselage.obj", None, 1e3, PLACE, "is 3e+04 x 4e+03 x 4e+03 m large if its coordinates are millimetres"),
        ("fuselage.glb", np.eye(3), 1.0, PLACE, 'with up = "z" it is inside'),
        ("fuselage.stl", None, 1.0, "position_mm = [0, 0, -3000]", "reaches below the floor of 40 x 25 x 12 m"),
        ("fuselage.step", None, 1.0, "position_mm = [10000, 0, 0]", "reaches beyond the hall of 40 x 25 x 12 m"),
    ],
)
def test_a_body_that_cannot_be_meant_so_is_a_question(
    name: str, turn: np.ndarray | None, scale: float, place: str, sentence: str, tmp_path: Path
) -> None:
    if name.endswith("step"):
        pytest.importorskip("cascadio", reason="the extra step is not installed")
    plan = written(tmp_path, name, Y_UP_TO_Z_UP.T if turn is None else turn)
    if scale != 1.0:
        trimesh.load(tmp_path / name).apply_scale(scale).export(tmp_path / name)
    plan.write_text(plan.read_text().replace(PLACE, place))
    with pytest.raises(InputError) as caught:
        load_plan(plan)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)
    if '"in"' in sentence:
        plan.write_text(plan.read_text().replace("position_mm", 'unit = "in"\nposition_mm', 1))
        assert "30 x 4 x 4 m" in placed_obstacles(load_plan(plan)[1])[0].description
    if "beyond_room" in str(caught.value):
        plan.write_text(plan.read_text().replace("position_mm", "beyond_room = true\nposition_mm", 1))
        load_plan(plan)


@pytest.mark.parametrize("suffix", ["stl", "obj"])
def test_single_precision_at_grid_coordinates_is_refused_where_it_is_lost(suffix: str, tmp_path: Path) -> None:
    far = trimesh.creation.box((1000.0, 800.0, 600.0))
    far.apply_translation((2.7e9, 5.3e9, 4.7e5))
    far.export(tmp_path / f"far.{suffix}")
    if suffix == "obj":
        assert np.ptp(read_cad_file(tmp_path / "far.obj").triangles, axis=(0, 1)) == pytest.approx([1.0, 0.8, 0.6])
        return
    with pytest.raises(InputError, match=r"single precision .* resolution is 512 mm; export it with its origin near"):
        read_cad_file(tmp_path / "far.stl")
    with pytest.raises(InputError, match=r"resolution is 5.12e\+05 mm"):
        read_cad_file(tmp_path / "far.stl", unit="m")
    near = trimesh.creation.box((1000.0, 800.0, 600.0))
    near.apply_translation((2.7e5, 5.3e5, 4.7e3))
    near.export(tmp_path / "near.stl")
    assert np.ptp(read_cad_file(tmp_path / "near.stl").triangles, axis=(0, 1)) == pytest.approx(
        [1.0, 0.8, 0.6], abs=1e-4
    )


@pytest.mark.parametrize("suffix", [".stl", ".glb"])
def test_a_body_that_vanishes_on_the_grid_is_refused_in_a_sentence(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"body{suffix}"
    trimesh.creation.box(extents=(1e-9, 1e-9, 1e-9)).export(file)
    with pytest.raises(InputError, match=r"body\.\w+: the file has no triangle larger than 10 um"):
        read_cad_file(file)


def test_a_body_whose_points_have_two_coordinates_is_refused(tmp_path: Path) -> None:
    """The rows of points were divided by three: a traceback."""
    file = tmp_path / "flat.obj"
    file.write_text("v 0 0\nv 300 0\nv 300 300\nv 0 300\nf 1 2 3\nf 1 3 4\n")
    with pytest.raises(InputError, match="without three coordinates"):
        read_cad_file(file)
