"""The 3D view: every part of the workshop is in it, sizes are stated, the page carries everything it needs."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import image
from matplotlib.colors import to_rgb

from ltsim.core.randomness import random_stream
from ltsim.reports import scene3d, workshop_scene
from ltsim.reports.document_model import CONTENT_SECURITY_POLICY, NoteBlock
from ltsim.reports.figures.floor_plan import floor_plan
from ltsim.reports.figures.obstacles import MAX_VECTOR_TRIANGLES
from ltsim.reports.scene_page import scene_page
from ltsim.reports.sections.network import scene_block
from ltsim.reports.style import svg_text
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.sections import Obstacle
from tests.reports import samples


@pytest.fixture(scope="module")
def scene() -> workshop_scene.WorkshopScene:
    return workshop_scene.workshop_from_recording(samples.recording())


def test_everything_stands_in_the_scene(scene: workshop_scene.WorkshopScene) -> None:
    plotter, legend = scene3d.build_scene(scene)
    names = set(plotter.actors)
    expected = {"floor", "wall-0", "wall-1", "sights", "cone-0", "shadow-4", "targets", "gauge", "gauge-lengths"}
    assert expected | {"tripods", "heads", "ellipsoids", "corrections", "rims"} <= names
    assert legend.colour_bar is not None
    plotter.close()


def relative_luminance(colours: np.ndarray) -> np.ndarray:
    """Relative luminance of sRGB colours (..., 3), 0 to 1, by WCAG 2.1."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return linear @ np.array([0.2126, 0.7152, 0.0722])


def on_dark_page(colours: np.ndarray) -> np.ndarray:
    """Colours (..., 3) after the filters `invert(1) hue-rotate(180deg)` of a dark page."""
    to_grey = np.tile([0.213, 0.715, 0.072], (3, 1))
    return np.clip((1.0 - colours) @ (2.0 * to_grey - np.eye(3)).T, 0.0, 1.0)


@pytest.mark.parametrize("page", ["light", "dark"])
def test_lines_of_sight_have_the_contrast_of_graphics(page: str, scene: workshop_scene.WorkshopScene) -> None:
    plotter, _ = scene3d.build_scene(scene)
    assert plotter.actors["sights"].prop.opacity == 1.0
    plotter.close()
    lines = scene3d.SIGHT_COLOUR_MAP(np.linspace(0.0, 1.0, 128))[:, :3]
    floor, wall = (np.array(to_rgb(colour)) for colour in (scene3d.FLOOR_COLOUR, scene3d.WALL_COLOUR))
    for surroundings in (np.ones(3), floor, 0.45 + 0.55 * wall, 0.45 * floor + 0.55 * wall):
        pair = (lines, surroundings) if page == "light" else (on_dark_page(lines), on_dark_page(surroundings))
        light = [relative_luminance(colours) + 0.05 for colours in pair]
        contrast = np.maximum(light[0] / light[1], light[1] / light[0])
        assert contrast.min() >= 3.0


def test_cone_ends_on_its_shadow(scene: workshop_scene.WorkshopScene) -> None:
    plotter, _ = scene3d.build_scene(scene)
    bounds = plotter.actors["cone-0"].bounds
    radius = scene.shadow_radii_on_floor[0]
    assert bounds[1] - bounds[0] == pytest.approx(2 * radius, rel=1e-3)
    assert bounds[4] == pytest.approx(0.0, abs=0.02)
    assert bounds[5] == pytest.approx(scene.station_positions[0, 2], abs=1e-3)
    plotter.close()


def test_ellipsoids_have_the_declared_magnification(scene: workshop_scene.WorkshopScene) -> None:
    assert scene.target_covariances is not None
    single = replace(
        scene,
        targets=scene.targets[:1],
        target_points=scene.target_points[:1],
        target_covariances=scene.target_covariances[:1],
    )
    single = replace(single, nest_normals=single.nest_normals[:1], gauge_pairs=(), sights=None, target_corrections=None)
    plotter, legend = scene3d.build_scene(single)
    magnification_line = next(line for line in legend.lines if "sigma" in line)
    factor = float("".join(c for c in magnification_line.split("enlarged")[1] if c.isdigit()))
    bounds = np.array(plotter.actors["ellipsoids"].bounds)
    half = 0.5 * (bounds[1::2] - bounds[::2])
    sigma = np.sqrt(np.diag(scene.target_covariances[0]))
    assert half == pytest.approx(factor * sigma, rel=0.05)
    plotter.close()


@pytest.mark.parametrize(
    ("length", "shown", "factor"), [(1e-5, 0.3, 2e4), (3e-6, 0.3, 1e5), (1.0, 0.1, 1.0), (0.0, 1.0, 1.0)]
)
def test_magnification_is_round(length: float, shown: float, factor: float) -> None:
    assert scene3d.round_magnification(length, shown) == pytest.approx(factor)


def test_picture_is_drawn(scene: workshop_scene.WorkshopScene) -> None:
    pixels = np.asarray(image.imread(io.BytesIO(scene3d.scene_png(scene, window_size=(500, 400)))))
    assert pixels.shape[:2] == (400, 500)
    assert (pixels[:, :, :3] < 0.97).any(axis=2).mean() > 0.2
    assert len(np.unique(pixels.reshape(-1, pixels.shape[2]), axis=0)) > 500


def test_page_escapes_the_title_and_names_no_server(scene: workshop_scene.WorkshopScene) -> None:
    html = scene_page(replace(scene, title='<script>alert("x")</script>'))
    assert "<script>alert" not in html
    assert "&lt;script&gt;" in html
    assert "kitware.github.io/vtk-js/icon" not in html
    assert "enlarged" in html


def test_page_has_the_policy_of_the_report(scene: workshop_scene.WorkshopScene) -> None:
    head = scene_page(scene).partition("</head>")[0]
    assert f'<meta http-equiv="Content-Security-Policy" content="{CONTENT_SECURITY_POLICY}">' in head


def test_station_names_may_be_long_or_foreign(scene: workshop_scene.WorkshopScene) -> None:
    names = ("漢字", "a" * 60, "S 3", "é", "-")
    html = scene_page(replace(scene, stations=names))
    assert len(html) > 1e6


def test_a_name_that_would_cover_another_is_excluded_and_that_is_reported(scene: workshop_scene.WorkshopScene) -> None:
    places = scene.target_points.copy()
    places[1] = places[0]
    words = {}
    for points in (scene.target_points, places):
        plotter, legend = scene3d.build_scene(replace(scene, target_points=points))
        words[points is places] = next((line for line in legend.lines if line.startswith("omitted names")), "")
        plotter.close()
    assert scene.targets[1] in words[True]
    assert scene.targets[0] not in words[True]
    assert scene.targets[1] not in words[False]


def test_scenario_stands_as_planned() -> None:
    scenario = load_scenario("paper-workshop")
    shown = workshop_scene.workshop_from_scenario(scenario)
    assert shown.station_positions[0] == pytest.approx(np.array(scenario.stations["S1"].position_mm) / 1e3)
    assert shown.sights is not None
    assert len(shown.sights.station_indices) == 5 * 28
    assert len(shown.gauge_pairs) == 6


def test_obstacle_hides_and_is_drawn() -> None:
    scenario = load_scenario("paper-workshop")
    press = Obstacle(name="press", box_mm=(1200, 800, 2600), position_mm=(1500, 1500, 0))
    room = scenario.workshop.model_copy(update={"obstacles": (press,)})
    shown = workshop_scene.workshop_from_scenario(scenario.model_copy(update={"workshop": room}))
    assert shown.sights is not None
    assert len(shown.sights.station_indices) < 140
    assert shown.notes
    assert len(shown.blocked_sights) == 140 - len(shown.sights.station_indices)
    drawn = floor_plan(shown)
    assert any("slices are" in text.get_text() for text in drawn.legends[0].get_texts())
    counts = [len(dots.get_offsets()) for dots in drawn.axes[0].collections if len(dots.get_paths()[0]) == 26]
    _circles, *slices = counts
    assert slices == np.bincount(shown.sights.station_indices, minlength=5).tolist()
    plotter, _ = scene3d.build_scene(shown)
    bounds = plotter.actors["obstacles"].bounds
    assert bounds == pytest.approx((0.9, 2.1, 1.1, 1.9, 0.0, 2.6))
    plotter.close()


def test_triangles_of_both_senses_are_filled_where_they_overlap() -> None:
    """The upper and the lower side of a body are seen in opposite senses from above."""
    upper = np.array([[[1.0, 1.0, 1.0], [4.0, 1.0, 1.0], [1.0, 4.0, 1.0]]])
    room = workshop_scene.workshop_from_scenario(load_scenario("paper-workshop"))
    pixels = []
    for obstacles in (upper, np.concatenate([upper, upper[:, ::-1] - [0.0, 0.0, 1.0]])):
        figure, stream_ = floor_plan(replace(room, obstacle_triangles=obstacles)), io.BytesIO()
        figure.savefig(stream_, format="png")
        stream_.seek(0)
        pixels.append(image.imread(stream_))
    assert np.abs(pixels[0] - pixels[1]).mean() < 1e-3


def test_a_body_of_many_triangles_takes_no_more_of_a_page_than_its_picture() -> None:
    """As vectors 200,000 triangles made a page of 45 MB, in 30 s."""
    few = workshop_scene.workshop_from_scenario(load_scenario("paper-workshop"))
    body = random_stream(3, "bodies").uniform(0.0, 3.0, (MAX_VECTOR_TRIANGLES + 1, 3, 3))
    sizes = [
        len(svg_text(floor_plan(replace(few, obstacle_triangles=body[:count]))))
        for count in (1, MAX_VECTOR_TRIANGLES + 1)
    ]
    assert sizes[1] - sizes[0] < 100_000


def test_too_many_stations_are_reported_and_not_drawn(scene: workshop_scene.WorkshopScene) -> None:
    """3,000 stations took minutes: each is drawn by itself."""
    copies = 501
    many = replace(
        scene,
        stations=tuple(f"S{i}" for i in range(copies)),
        station_positions=np.repeat(scene.station_positions[:1], copies, axis=0),
        station_rotations=np.repeat(scene.station_rotations[:1], copies, axis=0),
    )
    block = scene_block(many)
    assert isinstance(block, NoteBlock) and "501 stations are too many to draw" in block.text
