"""3D scene of a hall as one HTML page that works offline, with the viewer of vtk.js."""

import io
import json
import re
import zipfile
from html import escape
from typing import Any

import numpy as np
import pyvista as pv
from matplotlib.colors import to_hex
from PIL import Image
from trame_vtk.modules.vtk import serializers
from trame_vtk.tools.vtksz2html import write_html

from ltsim.core.errors import as_printable
from ltsim.core.notation import number_text
from ltsim.reports import scene3d
from ltsim.reports.document_model import CONTENT_SECURITY_POLICY
from ltsim.reports.formatting import typographic_text
from ltsim.reports.workshop_scene import WorkshopScene

SCENE_PAGE_CSS = """
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
"""Style sheet of the page with a 3D scene."""
SCENE_PAGE_HEAD = f'<meta http-equiv="Content-Security-Policy" content="{CONTENT_SECURITY_POLICY}">'
"""Elements for the head of the page: content security policy, and the name of ltsim as generator."""
SCENE_PAGE_HEAD += '<meta name="generator" content="ltsim">'


N_COORDINATE_STEPS = 40_000
"""Number of steps across a scene to which coordinates are rounded, so that the page compresses well.

A step is smaller than a pixel.
"""


def scene_page(workshop: WorkshopScene, camera: scene3d.Camera | None = None) -> str:
    """Self-contained HTML page with the interactive 3D scene of a hall, seen from `camera` if it is given."""
    plotter, legend = scene3d.build_scene(workshop, camera=camera)
    html = _page_html(plotter, workshop, legend)
    plotter.close()
    return html


def scene_picture_and_page(workshop: WorkshopScene) -> tuple[Image.Image, scene3d.SceneLegend, str]:
    """Picture, legend and interactive HTML page of the scene of a hall."""
    plotter, legend = scene3d.build_scene(workshop, window_size=(1200, 860))
    html = _page_html(plotter, workshop, legend)
    scene3d.write_legend(plotter, "", scene3d.SceneLegend((), legend.colour_bar))
    return scene3d.capture_and_close(plotter), legend, html


def _page_html(plotter: pv.Plotter, workshop: WorkshopScene, legend: scene3d.SceneLegend) -> str:
    """HTML page with the scene of a plotter, the title of the hall, and the legend."""
    step = 2.0 ** np.floor(np.log2(workshop.largest_extent / N_COORDINATE_STEPS))
    for actor in plotter.actors.values():
        mesh = getattr(getattr(actor, "mapper", None), "dataset", None)
        if mesh is not None:
            mesh.points = (step * np.round(mesh.points / step)).astype(np.float32)
    plotter.render()
    stream = io.StringIO()
    write_html(_zip_archive(_vtk_scene(plotter.render_window)), stream)
    html = FAVICON_URL_PATTERN.sub("data:,", stream.getvalue())
    title = escape(as_printable(workshop.title or "Workshop"))
    html = re.sub(r"<title>.*?</title>", lambda _: f"<title>{title}</title>", html, count=1)
    html = html.replace("<head>", f"<head>{SCENE_PAGE_HEAD}", 1)
    html = html.replace("</style>", SCENE_PAGE_CSS + "</style>", 1)
    html = html.replace("<body>", '<body><div class="content"></div>', 1)
    before, _, after = html.rpartition("</body>")
    return f"{before}{_legend_html(title, legend)}</body>{after}"


def _legend_html(title: str, legend: scene3d.SceneLegend) -> str:
    """HTML of the title, the legend and the colour bar over a scene."""
    lines = "".join(f"<p>{escape(as_printable(line))}</p>" for line in legend.lines)
    html_parts = [f'<div id="legend"><h1>{title}</h1>{lines}</div>']
    if legend.colour_bar is not None:
        label, low, high = legend.colour_bar
        stops = ", ".join(to_hex(scene3d.SIGHT_COLOUR_MAP(x)) for x in np.linspace(0, 1, 9))
        html_parts.append(
            f'<div id="bar">{escape(label)}<i style="background: linear-gradient(90deg, {stops})"></i>'
            f"{typographic_text(number_text(low))}<span>{typographic_text(number_text(high))}</span></div>"
        )
    html_parts.append('<div id="hint">drag: turn · wheel or pinch: zoom · shift-drag: move</div>')
    return "".join(html_parts)


FAVICON_URL_PATTERN = re.compile(r"https://kitware\.github\.io/vtk-js/icon/favicon-\$\{\w+\}x\$\{\w+\}\.png")
"""Pattern of the address of an icon that vtk.js loads from the network; it is replaced by an empty address."""

ZIP_ENTRY_DATE = (1980, 1, 1, 0, 0, 0)
"""Date of the entries of the archive with a scene, so that equal scenes give equal bytes."""


def _vtk_scene(window: Any) -> dict[str, Any]:
    """Scene of a render window in the format of vtk.js, with its arrays."""
    serializers.initialize_serializers()
    context = serializers.SynchronizationContext()
    context.set_ignore_last_dependencies(True)
    scene = serializers.serialize(None, window, serializers.reference_id(window), context, 1)
    camera = window.GetRenderers().GetFirstRenderer().GetActiveCamera()
    scene["extra"] = {
        "vtkRefId": serializers.reference_id(window),
        "centerOfRotation": camera.GetFocalPoint(),
        "camera": serializers.reference_id(camera),
    }
    arrays = {
        entry["hash"]: {**entry, "content": context.get_cached_data_array(entry["hash"], False)}
        for entry in serializers.extract_array_hash(scene)
    }
    return {"hashes": arrays, "scene": scene}


def _zip_archive(scene: dict[str, Any]) -> bytes:
    """Zip archive of a scene for the viewer, without dates."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        entry = zipfile.ZipInfo("index.json", ZIP_ENTRY_DATE)
        entry.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(entry, json.dumps(scene))
    return stream.getvalue()
