"""A pyvista scene in the page of vtk.js, without any server.

pyvista's own export starts a web server that tries to fetch a viewer from the net. Its serialiser and the viewer's page
lie in `trame-vtk`; used directly they need neither.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from typing import Any

import pyvista as pv
from trame_vtk.modules.vtk import serializers
from trame_vtk.tools.vtksz2html import write_html

FAVICON = re.compile(r"https://kitware\.github\.io/vtk-js/icon/favicon-\$\{\w+\}x\$\{\w+\}\.png")
"""vtk.js asks its maker's site for an icon when it loads; the address is replaced by an empty one."""

LONG_AGO = (1980, 1, 1, 0, 0, 0)


def viewer_page(plotter: pv.Plotter) -> str:
    """The scene as an HTML page with everything in it: viewer and data."""
    plotter.render()
    stream = io.StringIO()
    write_html(_packed(_scene(plotter.render_window)), stream)
    return FAVICON.sub("data:,", stream.getvalue())


def _scene(window: Any) -> dict[str, Any]:
    """The render window in vtk.js' own description, with its arrays."""
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


def _packed(scene: dict[str, Any]) -> bytes:
    """The zip that the viewer opens; it carries no date."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        entry = zipfile.ZipInfo("index.json", LONG_AGO)
        entry.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(entry, json.dumps(scene))
    return stream.getvalue()
