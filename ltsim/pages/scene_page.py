"""The workshop in 3D as one HTML page that opens offline: with a legend."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape

import numpy as np
import pyvista as pv
from matplotlib.colors import to_hex

from ltsim.pages import scene3d, solids
from ltsim.pages.document import POLICY
from ltsim.pages.style import INK, number, shorten
from ltsim.pages.viewer import viewer_page
from ltsim.pages.workshop import Workshop

STYLE = """
.content { position: fixed; inset: 0; touch-action: none; }
.content canvas { touch-action: none; }
body { font-family: system-ui, sans-serif; overflow: hidden; background: #fff; }
#legend { position: fixed; inset: 0.6rem auto auto 0.7rem; z-index: 9; pointer-events: none; color: #22272b;
  font-size: clamp(10px, 1.7vw, 13px); line-height: 1.4; max-width: min(24rem, 60vw); }
#legend h1 { font-size: 1.25em; margin: 0 0 .2em; overflow-wrap: anywhere; }
#legend p { margin: 0; }
#bar { position: fixed; inset: auto 0.8rem 0.7rem auto; z-index: 9; pointer-events: none; font-size: 12px;
  width: min(19rem, 60vw); }
#bar i { display: block; height: .7rem; border-radius: .2rem; margin: .15rem 0; }
#bar span { float: right; }
#hint { position: fixed; inset: auto auto 0.7rem 0.8rem; z-index: 9; pointer-events: none; color: #5c6166;
  font-size: 11px; }
@media (max-width: 34rem) { #hint { display: none; } #legend, #bar { background: #ffffffa6; } }
"""
HEAD = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}"><meta name="generator" content="ltsim">'


FINEST = 40_000
"""Steps of places across a scene: too small to see on a screen of 1400 pixels, and numbers of few digits pack well."""

Camera = Sequence[Sequence[float]]
"""Where it stands, where it looks to, and what is up there [m]."""


def scene_page(workshop: Workshop, camera: Camera | None = None) -> str:
    """One self-contained HTML page with the scene to turn; it asks nothing of any server."""
    plotter, legend = scene3d.build(workshop)
    if camera is not None:
        plotter.camera_position = [tuple(v) for v in camera]
    _solid_labels(plotter, workshop)
    step = 2.0 ** np.floor(np.log2(workshop.size / FINEST))
    for actor in plotter.actors.values():
        mesh = getattr(getattr(actor, "mapper", None), "dataset", None)
        if mesh is not None:
            mesh.points = (step * np.round(mesh.points / step)).astype(np.float32)
    html = viewer_page(plotter)
    plotter.close()
    title = escape(workshop.title or "Workshop")
    html = re.sub(r"<title>.*?</title>", lambda _: f"<title>{title}</title>", html, count=1)
    html = html.replace("<head>", f"<head>{HEAD}", 1)
    html = html.replace("</style>", STYLE + "</style>", 1)
    html = html.replace("<body>", '<body><div class="content"></div>', 1)
    return _before_last(html, "</body>", _overlay(title, legend))


def _overlay(title: str, legend: scene3d.Legend) -> str:
    """Title, what the signs mean, the colour bar, and how to turn the scene."""
    lines = "".join(f"<p>{escape(line)}</p>" for line in legend.lines)
    parts = [f'<div id="legend"><h1>{title}</h1>{lines}</div>']
    if legend.bar is not None:
        label, low, high = legend.bar
        stops = ", ".join(to_hex(scene3d.LINES(x)) for x in np.linspace(0, 1, 9))
        parts.append(
            f'<div id="bar">{escape(label)}<i style="background: linear-gradient(90deg, {stops})"></i>'
            f"{number(low)}<span>{number(high)}</span></div>"
        )
    parts.append('<div id="hint">drag: turn · wheel or pinch: zoom · shift-drag: move</div>')
    return "".join(parts)


def _before_last(html: str, mark: str, text: str) -> str:
    """Put `text` before the last `mark`."""
    at = html.rindex(mark)
    return html[:at] + text + html[at:]


def _solid_labels(plotter: pv.Plotter, workshop: Workshop) -> None:
    """Names as flat letters that face the first view: the page's viewer knows no screen text."""
    direction = np.array(plotter.camera.position) - np.array(plotter.camera.focal_point)
    size = 0.026 * workshop.size
    words = [
        _letters(name, place, direction, 1.5 * size)
        for name, place in _raised(workshop.stations, workshop.position, 0.33)
    ]
    plotter.add_mesh(solids.merged(words), color=INK, lighting=False, name="station-names")
    if len(workshop.targets) <= scene3d.MOST_LABELS:
        words = [
            _letters(name, place, direction, size) for name, place in _raised(workshop.targets, workshop.points, 0.1)
        ]
        plotter.add_mesh(solids.merged(words), color="#3A4046", lighting=False, name="target-names")


def _raised(names: tuple[str, ...], places: np.ndarray, up: float) -> list[tuple[str, np.ndarray]]:
    """Names with the places of their letters, a little above what they name."""
    return [(name, place + np.array([0.0, 0.0, up])) for name, place in zip(names, places, strict=True)]


def _letters(name: str, place: np.ndarray, direction: np.ndarray, height: float) -> pv.PolyData:
    """A short name of a given height [m], its plane square to `direction`."""
    text = shorten(name, 16).encode("latin-1", "replace").decode("latin-1")
    mesh = pv.Text3D(text, depth=0.0, height=height, center=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    out = direction / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0] if abs(out[2]) < 1 - 1e-9 else [-1.0, 0.0, 0.0], out)
    right /= np.linalg.norm(right)
    nearer = place + 0.25 * out  # clear of the wall that the target may stand on
    mesh.points = mesh.points @ np.stack([right, np.cross(out, right), out]) + nearer
    return mesh
