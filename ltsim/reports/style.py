"""Common style of all figures: colours, sizes, axes, export.

The colours of Okabe and Ito (2008) can be distinguished by colour-blind readers; marker or line style differ too, for
grey prints. Text is readable at the width of a phone; the page inverts the lightness on dark screens.
"""

import base64
import io
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from typing import Any, ParamSpec
from urllib.parse import quote

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from PIL import Image, WebPImagePlugin  # noqa: F401  # named, else `save` loads all forty formats to find it

from ltsim.core.arrays import Floats
from ltsim.reports.formatting import typographic_text

BLUE = "#0072B2"
"""Blue of Okabe and Ito."""
ORANGE = "#E69F00"
GREEN = "#009E73"
RED = "#D55E00"
SKY = "#56B4E9"
PURPLE = "#CC79A7"
GREY = "#8A8F94"
PALE_GREY = "#E8ECEF"
INK_COLOUR = "#22272B"
COLOUR_CYCLE = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, "#666666", INK_COLOUR)
"""Colours of successive lines of a figure."""
MARKERS = "osD^vP*X"
"""Markers of successive lines of a figure, which distinguish them in grey prints."""
COLOUR_BEFORE = GREY
"""Colour of values before a calibration."""
COLOUR_AFTER = BLUE
"""Colour of values after a calibration."""
BAND_COLOUR = "#8A8F9440"
"""Colour of interval bands, transparent for light and dark pages."""
DIVERGING_COLOUR_MAP = "RdBu_r"
"""Name of matplotlib's colour map for values with a sign."""
TEXT_COLOUR_ON_LIGHT = "#23282c"
"""Colour of text on a light cell."""
TEXT_COLOUR_ON_DARK = "#fefefe"
"""Colour of text on a dark cell."""

FIGURE_WIDTH_INCH = 4.9
"""Width of every figure [inch], at which text has nine pixels on a phone."""
LEGEND_LINE_LENGTH = 75
"""Length of a line of a legend [characters]."""
LEGEND_HANDLE_LENGTH = 8
"""Width of the line or marker before each label of a legend [characters]."""

_MATPLOTLIB_SETTINGS: dict[Any, Any] = {
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],
    "font.size": 8.5,
    "axes.prop_cycle": cycler(color=COLOUR_CYCLE),
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 8.5,
    "axes.edgecolor": "#6B7278",
    "axes.labelcolor": INK_COLOUR,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "grid.color": PALE_GREY,
    "grid.linewidth": 0.7,
    "xtick.color": "#4A5056",
    "ytick.color": "#4A5056",
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "text.color": INK_COLOUR,
    "text.parse_math": False,
    "text.usetex": False,  # a matplotlibrc in the working folder may request TeX
    "lines.linewidth": 1.4,
    "svg.fonttype": "none",
    "svg.hashsalt": "ltsim",
    "figure.dpi": 100,
    "savefig.dpi": 120,
    "savefig.transparent": True,
}
"""Settings of matplotlib for all figures."""
DrawParameters = ParamSpec("DrawParameters")


def darkened_colour_map(name: str, upper_end: float, *, max_luminance: float) -> ListedColormap:
    """Colour map `name` of matplotlib up to its fraction `upper_end`, without colours of a larger relative luminance.

    Brighter colours are darkened to `max_luminance` (0 to 1), so that only their hue varies. Source of the relative
    luminance: WCAG 2.1.
    """
    colours = mpl.colormaps[name](np.linspace(0.0, upper_end, 128))[:, :3]
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    linear *= np.minimum(max_luminance / (linear @ [0.2126, 0.7152, 0.0722]), 1.0)[:, None]
    return ListedColormap(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055))


def with_figure_style(draw: Callable[DrawParameters, Figure]) -> Callable[DrawParameters, Figure]:
    """Decorator that applies the settings of this module while the function `draw` draws a figure."""

    @wraps(draw)
    def draw_with_style(*args: DrawParameters.args, **kwargs: DrawParameters.kwargs) -> Figure:
        """Result of `draw` with the settings of this module."""
        with mpl.rc_context(_MATPLOTLIB_SETTINGS):
            return draw(*args, **kwargs)

    return draw_with_style


class NotebookFigure(Figure):
    """Figure that a notebook shows as a picture, even if pyplot is not imported."""

    def _repr_png_(self) -> bytes:
        """PNG of the figure, which a notebook shows."""
        return png_bytes(self)


def new_figure(height: float, *, layout: Any = "constrained") -> Figure:
    """Empty figure of a height [inch], without a window, whose `layout` places the axes automatically."""
    return NotebookFigure(figsize=(FIGURE_WIDTH_INCH, height), layout=layout)


def new_panel(height: float, *, layout: Any = "constrained") -> tuple[Figure, Axes]:
    """Empty figure of a height [inch], and its only axes; `layout` places the axes automatically."""
    figure = new_figure(height, layout=layout)
    return figure, figure.subplots()


def svg_text(figure: Figure) -> str:
    """SVG text of a figure, reproducible to the byte."""
    stream, layout, dpi = io.StringIO(), figure.get_layout_engine(), figure.dpi
    with mpl.rc_context(_MATPLOTLIB_SETTINGS):
        if layout is not None:  # `savefig` would draw everything twice, the first time for the layout alone
            FigureCanvasSVG(figure)
            figure.dpi = FigureCanvasSVG.fixed_dpi
            layout.execute(figure)
            figure.set_layout_engine(None)
        figure.savefig(stream, format="svg", metadata={"Date": None})
    figure.dpi = dpi
    figure.set_layout_engine(layout)
    return stream.getvalue()


def png_bytes(figure: Figure) -> bytes:
    """PNG of a figure for printing."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=150)
    return stream.getvalue()


def svg_data_uri(text: str) -> str:
    """Text of an SVG as a `data:` URI for an `img` element, in which scripts are not executed."""
    return "data:image/svg+xml," + quote(text, safe=" !$'()*+,/:;<=>?@[]{|}")


def webp_data_uri(picture: Image.Image) -> str:
    """Picture as WebP in a `data:` URI, a fifth of the size of PNG."""
    small = io.BytesIO()
    picture.convert("RGB").save(small, format="WEBP", quality=82)
    return "data:image/webp;base64," + base64.b64encode(small.getvalue()).decode()


def unit_text(unit: str) -> str:
    """Printed form of a unit."""
    return {"arcsec": '"', "deg": "°"}.get(unit, typographic_text(unit))


def set_grid(ax: Axes, *, grid_axis: str = "y") -> None:
    """Show the grid lines of one axis only ('x', 'y', 'both' or 'none')."""
    ax.grid(visible=False)
    if grid_axis != "none":
        ax.grid(visible=True, axis=grid_axis)  # type: ignore[arg-type]


def set_category_rows(ax: Axes, names: Sequence[str], *, font_size: float = 8.0) -> Floats:
    """Set the names of rows on the y axis, the first on top; returns the positions (n,) of the n rows."""
    places = np.arange(len(names), dtype=np.float64)
    ax.set_yticks(places, [shortened_name(name) for name in names], fontsize=font_size)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    set_grid(ax, grid_axis="x")
    return places


def write_at_right_of_rows(ax: Axes, positions: Floats, texts: Sequence[str]) -> None:
    """Write a text at the right end of each of n rows, at `positions` (n,) on the y axis."""
    right_axis = ax.secondary_yaxis("right")
    right_axis.set_yticks(positions, [typographic_text(text) for text in texts], fontsize=8)
    right_axis.tick_params(length=0)
    right_axis.spines["right"].set_visible(False)


LEGEND_LINE_HEIGHT_INCH = 0.2
"""Height [inch] of a line of a legend."""


def add_legend(figure: Figure, panels: Iterable[Axes], *, n_columns: int = 3) -> None:
    """Add a common legend above all panels, each label once; long labels are shortened."""
    handles = {label: handle for ax in panels for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    labels = [shortened_name(label) for label in handles]
    figure.legend(list(handles.values()), labels, ncols=n_legend_columns(labels, n_columns), loc="outside upper left")


def n_legend_columns(labels: Sequence[str], max_columns: int) -> int:
    """Number of legend columns that fit the longest label, at most `max_columns`."""
    return max(1, min(max_columns, LEGEND_LINE_LENGTH // (max(map(len, labels), default=0) + LEGEND_HANDLE_LENGTH)))


def legend_height(labels: Sequence[str], max_columns: int) -> float:
    """Height [inch] of a legend of labels in at most `max_columns` columns."""
    return LEGEND_LINE_HEIGHT_INCH * -(
        -len(labels) // n_legend_columns([shortened_name(label) for label in labels], max_columns)
    )


def shortened_name(name: str, max_length: int = 34) -> str:
    """Name of at most `max_length` characters, cut in the middle, since names often differ at their ends."""
    text_line, n_end_letters = " ".join(name.split()), max_length // 2
    return (
        text_line
        if len(text_line) <= max_length
        else f"{text_line[: max_length - 1 - n_end_letters]}…{text_line[-n_end_letters:]}"
    )
