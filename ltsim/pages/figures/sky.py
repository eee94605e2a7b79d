"""Where each station looks: azimuth and elevation of its pointings."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from ltsim.arrays import Floats, Ints
from ltsim.pages import style
from ltsim.pages.style import BLUE, ORANGE, RED, legend_of, new_figure, quiet_axis, shorten, styled
from ltsim.units import DEGREE

MOST_STATIONS = 12


@styled
def sky(
    stations: Sequence[str],
    station: Ints,
    azimuth: Floats,
    elevation: Floats,
    face: Ints,
    *,
    limits: tuple[float, float] | None,
) -> Figure:
    """One panel a station; lines mark the travel of the elevation axis.

    Parameters
    ----------
    stations : sequence of str
    station, face : (n,) int
    azimuth, elevation : (n,) float, [rad]
        Front face, in the station's own frame.
    limits : (float, float) or None, [rad]
        Lowest and highest elevation.
    """
    shown = list(stations)[:MOST_STATIONS]
    across = style.columns(min(3, max(len(shown), 1)))
    lines = -(-len(shown) // across)
    figure = new_figure(0.4 + 1.7 * lines)
    axes = figure.subplots(lines, across, sharex=True, sharey=True, squeeze=False)
    for s, ax in enumerate(axes.flat):
        if s >= len(shown):
            ax.set_axis_off()
            continue
        for number, colour, marker, size in ((1, BLUE, "o", 16), (2, ORANGE, "x", 11)):
            rows = (station == s) & (face == number)
            if rows.any():
                ax.scatter(
                    azimuth[rows] / DEGREE,
                    elevation[rows] / DEGREE,
                    s=size,
                    marker=marker,
                    color=colour,
                    linewidths=0.8,
                    label=f"face {number}",
                    alpha=0.85,
                )
        for limit in limits or ():
            ax.axhline(limit / DEGREE, color=RED, linewidth=0.9, linestyle=(0, (4, 2)), label="elevation limit")
        ax.tick_params(labelbottom=s + across >= len(shown))
        ax.set_title(shorten(shown[s], 24), fontsize=8.5)
        ax.set_xticks([-180, -90, 0, 90, 180])
        ax.set_xlim(-185, 185)
        quiet_axis(ax, grid="both")
    for ax in axes[:, 0]:
        ax.set_ylabel("elevation [°]")
    figure.supxlabel("azimuth [°]", fontsize=8.5)
    legend_of(figure, axes.flat, ncols=3)
    return figure
