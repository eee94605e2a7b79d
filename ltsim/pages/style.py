"""One look for every figure: colours, sizes, axes, and how a figure becomes bytes.

The colours are those of Okabe and Ito (2008), told apart by colour-blind eyes; what matters also differs in marker or
line, so that a grey print still reads.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, Literal, ParamSpec
from urllib.parse import quote

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from PIL import Image

from ltsim import notation
from ltsim.arrays import Floats

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, GREY, PALE, INK = "#56B4E9", "#CC79A7", "#8A8F94", "#E8ECEF", "#22272B"
CYCLE = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, "#666666", INK)
MARKERS = "osD^vP*X"
"""Beside the colours: what a grey print still tells apart."""
BEFORE, AFTER = GREY, BLUE
SEQUENTIAL, DIVERGING = "viridis", "RdBu_r"

WIDTH = 7.4
"""Inches: the text width of the page and of a printed A4."""

PHONE = 3.9
"""Inches: the text width of a phone."""
_narrow: ContextVar[bool] = ContextVar("narrow", default=False)

OBSERVABLE_UNIT = {"distance": "um", "azimuth": "arcsec", "elevation": "arcsec"}
READABLE = {"um": "µm", "urad": "µrad", "arcsec": '"', "deg": "°", "": ""}

_SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.prop_cycle": cycler(color=CYCLE),
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 8.5,
    "axes.edgecolor": "#6B7278",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "grid.color": PALE,
    "grid.linewidth": 0.7,
    "xtick.color": "#4A5056",
    "ytick.color": "#4A5056",
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "text.color": INK,
    "text.parse_math": False,
    "lines.linewidth": 1.4,
    "svg.fonttype": "path",
    "svg.hashsalt": "ltsim",
    "figure.dpi": 100,
    "savefig.dpi": 170,
}

DARK = {
    "#ffffff": "#16191c", "#000000": "#e6e9ec", INK: "#e6e9ec", PALE: "#2b3035", "#f7f8f9": "#1c2024",
    "#6b7278": "#8d949a", "#4a5056": "#b4bac0", "#3a4046": "#b4bac0", "#5c6166": "#a5abb1", "#b5bbc0": "#5c6166",
    BLUE: "#4aa3df",
}  # fmt: skip
"""What a figure's colours become where the reader's screen is dark; others serve on both."""
ON_PALE, ON_DEEP = "#23282c", "#fefefe"
"""Letters on coloured cells, which keep their colour on a dark screen."""
_DOTS = re.compile(r'(?<=data:image/png;base64,)[^"]+')
_PLACES = re.compile(r'(?:\bd="|\b[xy]="|\btranslate\()[^")]+')
_INDENT = re.compile(r" *\n *")
_LETTER = re.compile(r'<use xlink:href="([^"]+)" transform="translate\(([-\d.]+) 0\)"/>')
_DECIMALS = re.compile(r"-?\d+\.\d{3,}")
_PATH = re.compile(r'(?<=\bd=")[^"]+')
_AROUND = re.compile(r"\s*([A-Za-z])\s*")
_PLAIN = "!$'()*+,/:;<=>?@[]{|}"
"""Characters that stand for themselves in an address between quotation marks."""

P = ParamSpec("P")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Draw a figure under the common settings; nothing global changes."""

    @wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(_SETTINGS):
            figure = draw(*args, **kwargs)
        if isinstance(figure, PageFigure):
            figure.again = partial(inside, *args, **kwargs)
        return figure

    return inside


class PageFigure(Figure):
    """A figure that can be drawn `again`, as narrow as a phone."""

    again: Callable[[], Figure] | None = None

    def legend(self, *args: Any, **kwargs: Any) -> Legend:
        """As in matplotlib; on a phone it goes below, in two columns at most."""
        if _narrow.get():
            kwargs |= {"loc": "outside lower center", "ncols": min(kwargs.get("ncols", 2), 2)}
        return super().legend(*args, **kwargs)


def narrow(figure: Figure) -> Figure | None:
    """The same figure for a phone; None where it cannot be drawn again."""
    if not isinstance(figure, PageFigure) or figure.again is None:
        return None
    before = _narrow.set(True)
    try:
        return figure.again()
    finally:
        _narrow.reset(before)


def on_phone() -> bool:
    """Whether the figure is drawn for a phone."""
    return _narrow.get()


def columns(wanted: int) -> int:
    """How many panels stand side by side: at most two on a phone."""
    return min(wanted, 2) if _narrow.get() else wanted


def new_figure(
    height: float, *, width: float = WIDTH, layout: Literal["constrained", "compressed"] = "constrained"
) -> Figure:
    """An empty figure [inch] that arranges itself and belongs to no window."""
    return PageFigure(figsize=(min(width, PHONE) if _narrow.get() else width, height), layout=layout)


def svg(figure: Figure) -> str:
    """The figure as SVG text, the same bytes for the same data."""
    stream = io.StringIO()
    with mpl.rc_context(_SETTINGS):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    text = _DOTS.sub(lambda found: _fewer_colours(found.group()), stream.getvalue())
    text = _PLACES.sub(lambda found: _DECIMALS.sub(_shorter, found.group()), text)
    text = _PATH.sub(lambda found: _AROUND.sub(r"\1", found.group()).replace(" ", ","), text)
    text = _LETTER.sub(r'<use xlink:href="\1" x="\2"/>', _INDENT.sub("\n", text))
    text = text.replace("DejaVuSans-", "f").replace("xlink:href=", "href=")
    return text.replace("<defs>", f"<defs>{_dark_rules()}", 1)


def _shorter(place: re.Match[str]) -> str:
    """A coordinate to a hundredth of a point."""
    return f"{float(place.group()):.2f}".rstrip("0").rstrip(".")


def _fewer_colours(png: str) -> str:
    """A base64 PNG with 64 colours: dots of two or three colours need no more, and take a quarter of the room."""
    small = io.BytesIO()
    Image.open(io.BytesIO(base64.b64decode(png))).quantize(64, method=Image.Quantize.FASTOCTREE).save(
        small, format="PNG", optimize=True
    )
    return base64.b64encode(small.getvalue()).decode()


def _dark_rules() -> str:
    """Style of an SVG that follows the reader's choice of a dark screen."""
    rules = "".join(
        f'[style*="{what}: {light.lower()}"]{{{what}:{dark}!important}}'
        for light, dark in DARK.items()
        for what in ("fill", "stroke")
    )
    return f"<style>@media screen and (prefers-color-scheme:dark){{{rules}}}</style>"


def svg_uri(figure: Figure) -> str:
    """The figure as a `data:` address for an `img`; names in it can run nothing."""
    return svg_text_uri(svg(figure))


def svg_text_uri(text: str) -> str:
    """The same of an SVG that is written already; without quotation marks, so that a page holds it as it is.

    The text itself takes three quarters of the room of its base64.
    """
    return "data:image/svg+xml," + quote(text.replace("\n<", "<").replace('"', "'"), safe=_PLAIN)


def narrow_uri(figure: Figure) -> str:
    """The figure for a phone as a `data:` address; empty where its panels have no room there."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            small = narrow(figure)
            return svg_uri(small) if small else ""
        except UserWarning:  # the layout gives up
            return ""


def webp_uri(png: bytes) -> str:
    """A PNG of a scene as a `data:` address of a fifth of its size."""
    small = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").save(small, format="WEBP", quality=88)
    return "data:image/webp;base64," + base64.b64encode(small.getvalue()).decode()


def unit_text(unit: str) -> str:
    """How a unit is printed."""
    return READABLE.get(unit, unit)


def quiet_axis(ax: Axes, *, grid: str = "y") -> None:
    """Keep grid lines of one direction only ('x', 'y', 'both' or 'none')."""
    ax.grid(visible=False)
    if grid != "none":
        ax.grid(visible=True, axis=grid)  # type: ignore[arg-type]


def category_rows(ax: Axes, names: Sequence[str], *, size: float = 8.0) -> Floats:
    """Put names on the y axis, the first on top; gives their places."""
    places = np.arange(len(names), dtype=np.float64)
    ax.set_yticks(places, [shorten(name) for name in names], fontsize=size)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    quiet_axis(ax, grid="x")
    return places


def at_right(ax: Axes, places: Floats, texts: Sequence[str]) -> None:
    """Texts beside the rows, at the right end."""
    right = ax.secondary_yaxis("right")
    right.set_yticks(places, texts, fontsize=8)
    right.tick_params(length=0)
    right.spines["right"].set_visible(False)


def bare(ax: Axes) -> None:
    """Take frame, grid and ticks off a table of colours."""
    ax.tick_params(length=0)
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)


def legend_of(figure: Figure, panels: Iterable[Axes], *, ncols: int) -> None:
    """One legend for all panels, each label once."""
    known = {label: handle for ax in panels for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(list(known.values()), list(known), loc="outside upper right", ncols=ncols)


def shorten(name: str, most: int = 34) -> str:
    """A name that fits on an axis."""
    flat = " ".join(name.split())
    return flat if len(flat) <= most else flat[: most - 1] + "…"


def number(value: float | None, digits: int = 3) -> str:
    """A number as `ltsim.notation` writes it, with the signs of print."""
    return typeset(notation.number(value, digits))


def with_sigma(value: float, sigma: float) -> str:
    """`value ± sigma`, sigma one standard deviation."""
    return typeset(notation.with_sigma(value, sigma))


def typeset(text: str) -> str:
    """A number of `ltsim.notation` with the signs of print: ±, a minus, a long dash for none, µm."""
    if text == notation.NONE:
        return "–"
    return _minus(text.replace("+-", "±").replace(" um", " µm"))


def fixed(value: float | None, decimals: int) -> str:
    """A number with so many decimals, a dash for none; thousands are not divided, so that it can be copied."""
    return "–" if value is None or not np.isfinite(value) else _minus(f"{value:.{decimals}f}")


def with_unit(value: float, sigma: float | None, unit: str) -> str:
    """`value ± sigma unit`."""
    return f"{with_sigma(value, sigma or 0.0)} {unit_text(unit)}"


def _minus(text: str) -> str:
    """A hyphen at the head of a number becomes a minus sign; a negative zero loses it."""
    bare = text.lstrip("-")
    return bare if bare == text or not bare.strip("0.") else "−" + bare
