"""Picture from a few lines of Python, drawn while the documentation is built and not committed."""

import base64
import contextlib
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib.figure import Figure

import ltsim as lt
from from_code.pictures import Pictures
from ltsim.reports import scene3d
from ltsim.reports.style import svg_data_uri, svg_text

HOW_TO = Path(__file__).resolve().parents[1] / "how-to"
"""Folder of the files that the how-to guides offer for download."""


def shown(pictures: Pictures, lines: list[str], name: str) -> str:
    """Markdown of the figure or view that the last line of code returns; the first of `lines` is the caption."""
    caption, *code, last = lines
    names: dict[str, Any] = {"lt": lt, "how_to": HOW_TO}
    with TemporaryDirectory() as place, contextlib.chdir(place):
        exec("\n".join(code), names)
        made = eval(last, names)
    if isinstance(made, Figure):
        address = svg_data_uri(svg_text(made))
    else:
        picture = base64.b64encode(scene3d.scene_png(made.workshop, window_size=(1000, 720))).decode()
        address = f"data:image/png;base64,{picture}"
    return f"{pictures.keep(name, address, caption)}\n\n*{caption}*"
