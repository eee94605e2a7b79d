"""3D scene of a hall with pyvista: picture and window."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyvista as pv
from PIL import Image
from vtkmodules.vtkCommonCore import vtkLogger

from ltsim.core.arrays import Floats, Ints
from ltsim.core.notation import names_text
from ltsim.core.units import DEGREE
from ltsim.reports import style
from ltsim.reports.workshop_scene import WorkshopScene

WALL_COLOUR = "#D5DBE0"
FLOOR_COLOUR = "#E3E7EA"
TRIPOD_LEG_COLOUR = "#5C6166"
MAX_DRAWN_ARROWS = 300
"""Largest number of correction arrows in a scene; if there are more, the longest arrows are drawn."""
MAX_FLOOR_METRE_LINES = 200
"""Largest number of lines at full metres on the floor; a larger hall is drawn without them."""
MAX_LISTED_OMITTED_NAMES = 4
"""Largest number of names, omitted for lack of space, that the legend lists."""
MAX_TARGET_LABELS = 60
"""Largest number of targets whose names are drawn."""
MAX_FINE_SPHERES = 150
"""Largest number of targets with finely meshed spheres and ellipsoids; for more targets they have fewer facets."""
MAX_MEDIUM_SPHERES = 600
"""Largest number of targets with moderately meshed spheres and ellipsoids; for more targets they have the fewest
facets."""
SIGHT_COLOUR_MAP = style.darkened_colour_map("viridis", 0.95, max_luminance=0.2)
"""Colour map of the values of lines of sight. It has a contrast of at least 3:1 to background, floor and walls, on
light pages and on dark ones, which invert the lightness. Source of the ratio: WCAG 2.1, success criterion 1.4.11."""

vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # suppresses a warning about a missing display


@dataclass(frozen=True)
class SceneLegend:
    """Legend of a scene: lines of text, and the colour bar of the lines of sight."""

    lines: tuple[str, ...]
    colour_bar: tuple[str, float, float] | None = None
    """Label, lowest and highest value of the colours; None without lines of sight."""


def round_magnification(length: float, drawn_length: float) -> float:
    """Magnification (1, 2 or 5 times a power of ten, at least 1) that draws `length` about `drawn_length` long."""
    if not length > 0:
        return 1.0
    exact_factor = drawn_length / length
    power = 10.0 ** np.floor(np.log10(exact_factor))
    mantissa = max(s for s in (1.0, 2.0, 5.0) if s <= exact_factor / power * (1 + 1e-9))
    return float(max(mantissa * power, 1.0))


def magnification_text(magnification: float) -> str:
    """Text of a magnification, with a space between thousands: `2 000`."""
    return f"{magnification:,.0f}".replace(",", " ")


Camera = Sequence[Sequence[float]]
"""Camera of a scene: position (3,) [m], focal point (3,) [m] and up direction (3,)."""


def build_scene(
    workshop: WorkshopScene,
    *,
    window_size: tuple[int, int] = (1400, 1000),
    off_screen: bool = True,
    camera: Camera | None = None,
) -> tuple[pv.Plotter, SceneLegend]:
    """Plotter of pyvista and legend of the scene of a hall; `window_size` in pixels, visible unless `off_screen`."""
    plotter = pv.Plotter(off_screen=off_screen, window_size=list(window_size), lighting="three lights")
    plotter.background_color = pv.Color("white")
    _draw_surroundings(plotter, workshop)
    lines: list[str] = []
    bar = _draw_sights(plotter, workshop)
    _draw_shadow_cones(plotter, workshop, lines)
    _draw_targets(plotter, workshop)
    _draw_stations(plotter, workshop)
    _draw_uncertainty_ellipsoids(plotter, workshop, lines)
    _draw_correction_arrows(plotter, workshop, lines)
    lines.extend(workshop.notes)
    _place_camera(plotter, workshop)
    if camera is not None:
        plotter.camera_position = [tuple(v) for v in camera]
    _draw_names(plotter, workshop, lines)
    return plotter, SceneLegend(tuple(lines), bar)


def scene_png(workshop: WorkshopScene, *, window_size: tuple[int, int] = (1400, 1000)) -> bytes:
    """PNG of the scene of a hall, with title, legend and colour bar; `window_size` in pixels."""
    plotter, legend = build_scene(workshop, window_size=window_size)
    write_legend(plotter, workshop.title, legend)
    stream = io.BytesIO()
    capture_and_close(plotter).save(stream, format="PNG")
    return stream.getvalue()


def capture_and_close(plotter: pv.Plotter) -> Image.Image:
    """Image of the scene of a plotter, which is closed."""
    image = plotter.screenshot(return_img=True)
    plotter.close()
    return Image.fromarray(np.asarray(image))


def show_window(workshop: WorkshopScene) -> None:
    """Open a window with the scene of a hall; returns when it is closed."""
    plotter, legend = build_scene(workshop, off_screen=False)
    write_legend(plotter, workshop.title, legend)
    plotter.show()


def write_legend(plotter: pv.Plotter, title: str, legend: SceneLegend) -> None:
    """Draw title, legend and colour bar on a picture."""
    if title:
        plotter.add_text(
            title, position=(0.015, 0.955), viewport=True, font_size=13, color=style.INK_COLOUR, shadow=False
        )
    text = "\n".join(legend.lines)
    if text:
        actor = plotter.add_text(
            text, position=(0.015, 0.93 - 0.027 * len(legend.lines)), viewport=True, font_size=9, color=style.INK_COLOUR
        )
        actor.prop.SetLineSpacing(1.35)
    if legend.colour_bar is not None:
        plotter.add_scalar_bar(  # type: ignore[call-arg]
            title=legend.colour_bar[0] + "\n",
            color=style.INK_COLOUR,
            position_x=0.6,
            position_y=0.02,
            width=0.33,
            height=0.07,
            n_labels=3,
            title_font_size=26,
            label_font_size=24,
            fmt="%.3g",
            mapper=plotter.actors["sights"].mapper,
        )


def _draw_surroundings(plotter: pv.Plotter, workshop: WorkshopScene) -> None:
    """Draw floor, metre lines, walls and obstacles of a hall."""
    z = workshop.floor_height
    corners = np.column_stack([workshop.floor_corners, np.full(len(workshop.floor_corners), z - 0.002)])
    plotter.add_mesh(_polygon_mesh(corners), color=FLOOR_COLOUR, lighting=False, name="floor")
    ends = workshop.floor_corners.min(axis=0), workshop.floor_corners.max(axis=0)
    metres = [np.arange(np.ceil(low), high + 1e-9) for low, high in zip(*ends, strict=True)]
    if all(map(len, metres)) and sum(map(len, metres)) <= MAX_FLOOR_METRE_LINES:
        grid = pv.RectilinearGrid(*metres, [z]).extract_all_edges()
        plotter.add_mesh(grid, color="#CBD1D6", line_width=1, lighting=False, name="grid")
    for i, wall in enumerate(workshop.wall_corners):
        plotter.add_mesh(_polygon_mesh(wall), color=WALL_COLOUR, opacity=0.55, lighting=False, name=f"wall-{i}")
    if len(workshop.obstacle_triangles):
        corners = workshop.obstacle_triangles.reshape(-1, 3)
        triangles = pv.PolyData.from_regular_faces(corners, np.arange(len(corners)).reshape(-1, 3))  # type: ignore[arg-type]
        plotter.add_mesh(triangles, color="#B9A98C", name="obstacles")


def _draw_sights(plotter: pv.Plotter, workshop: WorkshopScene) -> tuple[str, float, float] | None:
    """Draw each sight once, coloured by its largest value; returns label, lowest and highest of these values."""
    sights = workshop.sights
    if sights is None or not len(sights.station_indices):
        return None
    pairs, place = np.unique(
        np.stack([sights.station_indices, sights.target_indices], axis=1), axis=0, return_inverse=True
    )
    value = np.full(len(pairs), -np.inf)
    np.maximum.at(value, place.ravel(), sights.colour_values)
    ends = np.stack([workshop.station_positions[pairs[:, 0]], workshop.target_points[pairs[:, 1]]], axis=1).reshape(
        -1, 3
    )
    mesh = pv.line_segments_from_points(ends)
    mesh.cell_data["value"] = value
    low, high = float(value.min()), float(value.max())
    plotter.add_mesh(
        mesh,
        scalars="value",
        cmap=SIGHT_COLOUR_MAP,
        clim=(low, high if high > low else low + 1.0),
        line_width=1.6,
        lighting=False,
        show_scalar_bar=False,
        name="sights",
    )
    return sights.colour_label, low, high


def _draw_shadow_cones(plotter: pv.Plotter, workshop: WorkshopScene, legend_lines: list[str]) -> None:
    """Draw the cone below each station in which the tracker sees nothing, and its circle on the floor.

    The opening angle is added to `legend_lines`.
    """
    rims = []
    for s, (position, radius) in enumerate(
        zip(workshop.station_positions, workshop.shadow_radii_on_floor, strict=True)
    ):
        floor_point = np.array([*position[:2], workshop.floor_height + 0.004])
        disc = pv.Polygon(center=floor_point, radius=float(radius), normal=(0.0, 0.0, 1.0), n_sides=72)
        rims.append(disc.extract_feature_edges())
        height = float(position[2] - floor_point[2])
        shape = {"direction": (0.0, 0.0, 1.0), "height": height, "radius": radius, "resolution": 72}
        cone = pv.Cone(center=0.5 * (position + floor_point), capping=False, **shape)
        plotter.add_mesh(cone, color=style.RED, opacity=0.13, lighting=False, name=f"cone-{s}")
        plotter.add_mesh(disc, color=style.ORANGE, opacity=0.30, lighting=False, name=f"shadow-{s}")
    plotter.add_mesh(pv.merge(rims), color=style.RED, line_width=3, lighting=False, name="rims")
    opening = f"{workshop.shadow_cone_opening / DEGREE:.0f}°"
    legend_lines.append(f"cone and disc: not visible from the station (cone of {opening})")


def _polygon_mesh(corners: Floats) -> pv.PolyData:
    """Mesh of a flat convex polygon with k corners (k, 3)."""
    return pv.PolyData(corners, faces=[len(corners), *range(len(corners))])


def _cylinder_mesh(begin: Floats, end: Floats, radius: float) -> pv.PolyData:
    """Mesh of a cylinder of this radius [m] around the line between two points `begin` and `end` (3,) [m]."""
    axis = end - begin
    height = float(np.linalg.norm(axis))
    return pv.Cylinder(center=0.5 * (begin + end), direction=axis, radius=radius, height=height, resolution=12)


def ellipsoid_mesh(centres: Floats, axes: Floats) -> pv.PolyData:
    """Mesh of k ellipsoids with centres (k, 3); the columns of each matrix in `axes` (k, 3, 3) are the semi-axes."""
    n_ellipsoids = len(centres)
    facets = (18, 12) if n_ellipsoids <= MAX_FINE_SPHERES else (8, 6) if n_ellipsoids <= MAX_MEDIUM_SPHERES else (6, 4)
    unit = pv.Sphere(radius=1.0, theta_resolution=facets[0], phi_resolution=facets[1])
    points = np.einsum("kij,nj->kni", axes, unit.points) + centres[:, None, :]
    first_corner = len(unit.points) * np.arange(n_ellipsoids, dtype=np.int64)[:, None, None]
    corners: Ints = (np.asarray(unit.regular_faces, dtype=np.int64)[None] + first_corner).reshape(-1, 3)
    return pv.PolyData.from_regular_faces(points.reshape(-1, 3).astype(np.float32), corners)  # type: ignore[arg-type]


def _draw_targets(plotter: pv.Plotter, workshop: WorkshopScene) -> None:
    """Draw targets as spheres, and the gauge (reflectors at known distances) as lines between its targets."""
    gauge = set(workshop.gauge_targets)
    radius = 0.009 * workshop.largest_extent
    for name, colour, chosen in (
        ("targets", style.BLUE, [i for i in range(len(workshop.targets)) if i not in gauge]),
        ("gauge", style.GREEN, sorted(gauge)),
    ):
        if chosen:
            axes = np.broadcast_to(np.eye(3) * radius, (len(chosen), 3, 3))
            plotter.add_mesh(
                ellipsoid_mesh(workshop.target_points[chosen], axes),
                color=colour,
                name=name,
                smooth_shading=len(chosen) <= MAX_FINE_SPHERES,
            )
    if workshop.gauge_pairs:
        ends = workshop.target_points[np.array(workshop.gauge_pairs).ravel()]
        plotter.add_mesh(
            pv.line_segments_from_points(ends), color=style.GREEN, line_width=3, lighting=False, name="gauge-lengths"
        )


def _draw_stations(plotter: pv.Plotter, workshop: WorkshopScene) -> None:
    """Draw each station as tripod and tracker head, with an arrow towards azimuth zero."""
    legs, heads, pointers = [], [], []
    for position, axes in zip(workshop.station_positions, workshop.station_rotations, strict=True):
        height = max(position[2] - workshop.floor_height, 0.3)
        spread = 0.28 * min(height, 2.0)
        top = position - np.array([0.0, 0.0, 0.22])
        for angle in np.array([90.0, 210.0, 330.0]) * DEGREE:
            foot_xy = position[:2] + spread * np.array([np.cos(angle), np.sin(angle)])
            foot = np.array([*foot_xy, workshop.floor_height])
            legs.append(_cylinder_mesh(top, foot, 0.018))
        legs.append(_cylinder_mesh(top, position - np.array([0.0, 0.0, 0.09]), 0.05))
        heads.append(pv.Cylinder(center=position, direction=axes[:, 1], radius=0.09, height=0.20, resolution=32))
        end = position + 0.30 * axes[:, 0]
        pointers.append(_cylinder_mesh(position, end, 0.022))
        pointers.append(
            pv.Cone(center=end + 0.06 * axes[:, 0], direction=axes[:, 0], height=0.12, radius=0.05, resolution=24)
        )
    plotter.add_mesh(pv.merge(legs), color=TRIPOD_LEG_COLOUR, name="tripods")
    plotter.add_mesh(pv.merge(heads), color=style.INK_COLOUR, name="heads")
    plotter.add_mesh(pv.merge(pointers), color=style.ORANGE, name="azimuth-zero")


def _draw_uncertainty_ellipsoids(plotter: pv.Plotter, workshop: WorkshopScene, legend_lines: list[str]) -> None:
    """Draw the one-sigma ellipsoids of the targets with a round magnification, which is added to the legend lines."""
    if workshop.target_covariances is None:
        return
    variances, axes = np.linalg.eigh(workshop.target_covariances)
    semi_axes = np.sqrt(np.maximum(variances, 0.0))
    typical_semi_axis = float(np.median(semi_axes.max(axis=1)))
    if not typical_semi_axis > 0:
        return
    scale = round_magnification(typical_semi_axis, 0.035 * workshop.largest_extent)
    ellipsoids = ellipsoid_mesh(workshop.target_points, axes * (scale * semi_axes)[:, None, :])
    plotter.add_mesh(
        ellipsoids, color=style.SKY, opacity=0.35, name="ellipsoids", smooth_shading=len(semi_axes) <= MAX_FINE_SPHERES
    )
    legend_lines.append(f"pale ellipsoids: 1 sigma of a target, enlarged {magnification_text(scale)} times")


def _draw_correction_arrows(plotter: pv.Plotter, workshop: WorkshopScene, legend_lines: list[str]) -> None:
    """Draw the corrections of the targets as arrows with a round magnification, which is added to the legend lines."""
    if workshop.target_corrections is None:
        return
    lengths = np.linalg.norm(workshop.target_corrections, axis=1)
    if not float(lengths.max()) > 0:
        return
    scale = round_magnification(float(np.percentile(lengths, 90)), 0.09 * workshop.largest_extent)
    min_drawn_length = max(1e-3 * float(lengths.max()), float(np.sort(lengths)[-MAX_DRAWN_ARROWS:][0]))
    arrows = [
        pv.Arrow(
            start=p,
            direction=c / n,
            scale=float(scale * n),
            shaft_radius=0.03,
            tip_radius=0.08,
            tip_length=0.3,
            shaft_resolution=8,
            tip_resolution=12,
        )
        for p, c, n in zip(workshop.target_points, workshop.target_corrections, lengths, strict=True)
        if n >= min_drawn_length
    ]
    plotter.add_mesh(pv.merge(arrows), color=style.PURPLE, name="corrections")
    limit_text = f" (the {MAX_DRAWN_ARROWS} largest)" if len(lengths) > MAX_DRAWN_ARROWS else ""
    legend_lines.append(f"arrows: correction of a target{limit_text}, enlarged {magnification_text(scale)} times")


def _draw_names(plotter: pv.Plotter, workshop: WorkshopScene, legend_lines: list[str]) -> None:
    """Draw names facing the camera, stations first; names that would cover others are listed in the legend."""
    eye = np.array(plotter.camera.position)
    axes = _axes_across_view(eye - np.array(plotter.camera.focal_point))
    size, drawn_boxes, omitted_names = 0.026 * workshop.largest_extent, list[tuple[Floats, Floats]](), list[str]()
    groups = [
        ("station-names", workshop.stations, workshop.station_positions, 0.15 + size, 1.5 * size, style.INK_COLOUR)
    ]
    if len(workshop.targets) <= MAX_TARGET_LABELS:
        groups.append(("target-names", workshop.targets, workshop.target_points, size, size, "#3A4046"))
    for key, names, places, height_above, height, colour in groups:
        words = []
        for name, place in zip(names, places + np.array([0.0, 0.0, height_above]), strict=True):
            word = _name_mesh(name, place, axes, height)
            if not word.n_points:  # characters without a glyph
                continue
            projected = (word.points - eye) @ axes.T
            low, high = (f(projected[:, :2] / -projected[:, 2:], axis=0) for f in (np.min, np.max))
            if any(np.all((low < top) & (bottom < high)) for bottom, top in drawn_boxes):
                omitted_names.append(name)
            else:
                drawn_boxes.append((low, high))
                words.append(word)
        if words:
            plotter.add_mesh(pv.merge(words), color=colour, lighting=False, name=key)
    if omitted_names:
        legend_lines.append(f"omitted names: {names_text(omitted_names, MAX_LISTED_OMITTED_NAMES)}")


def _axes_across_view(direction: Floats) -> Floats:
    """Unit vectors (3, 3) of a plane perpendicular to `direction` (3,): right, up, and along the direction."""
    outwards = direction / np.linalg.norm(direction)
    right_axis = np.cross([0.0, 0.0, 1.0] if abs(outwards[2]) < 1 - 1e-9 else [-1.0, 0.0, 0.0], outwards)
    right_axis /= np.linalg.norm(right_axis)
    return np.stack([right_axis, np.cross(outwards, right_axis), outwards])


def _name_mesh(name: str, place: Floats, axes: Floats, height: float) -> pv.PolyData:
    """Mesh of a name at the point `place` with letters of a height [m], in the plane of `axes` (3, 3)."""
    text = style.shortened_name(name, 16).replace("…", "..").encode("latin-1", "replace").decode("latin-1")
    mesh = pv.Text3D(text, depth=0.0, height=height, center=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    mesh.points = mesh.points @ axes + place + 0.25 * axes[2]  # in front of a wall behind the target
    return mesh


def _place_camera(plotter: pv.Plotter, workshop: WorkshopScene) -> None:
    """Place the camera above the side of the hall without walls, directed at the middle of the hall."""
    low = np.array([*workshop.floor_corners.min(axis=0), workshop.floor_height])
    top = max(workshop.target_points[:, 2].max(), workshop.station_positions[:, 2].max())
    high = np.array([*workshop.floor_corners.max(axis=0), top])
    middle = 0.5 * (low + high) - np.array([0.0, 0.0, 0.04 * (high - low)[2]])
    backs = workshop.wall_corners.mean(axis=1) if len(workshop.wall_corners) else workshop.target_points
    away = (middle if len(workshop.wall_corners) else workshop.station_positions.mean(axis=0)) - backs.mean(axis=0)
    open_side = np.array([1.0, 0.72]) * np.where(away[:2] < -1e-6, -1.0, 1.0)
    reach = 1.75 * float(np.linalg.norm(high - low))
    direction = np.array([*(open_side / np.linalg.norm(open_side)), 0.62])
    plotter.camera_position = [
        tuple(middle + reach * direction / np.linalg.norm(direction)),
        tuple(middle),
        (0.0, 0.0, 1.0),
    ]
    plotter.camera.view_angle = 32.0
    plotter.camera.clipping_range = (0.05 * reach, 6.0 * reach)
