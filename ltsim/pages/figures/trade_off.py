"""What a better layout costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ltsim.pages.style import BLUE, GREEN, GREY, RED, new_figure, quiet_axis, shorten, styled

COLOUR = {"tried": GREY, "best": BLUE, "chosen": RED, "reference": GREEN}
MARKER = {"tried": ".", "best": "o", "chosen": "*", "reference": "D"}
SIZE = {"tried": 34, "best": 30, "chosen": 150, "reference": 46}
WORD = {"tried": "tried", "best": "best at its cost", "chosen": "the plan", "reference": "reference"}


@dataclass(frozen=True)
class Layout:
    """One layout: cost, quality, and whether it is `tried`, `best` (at its cost), `chosen` or the `reference`."""

    name: str
    cost: float
    quality: float
    kind: str = "tried"


@styled
def trade_off(
    layouts: Sequence[Layout], *, cost: str = "time on the floor [min]", quality: str = "quality", lower: bool = True
) -> Figure:
    """Cost against quality; the line joins the best layouts.

    Parameters
    ----------
    layouts : sequence of Layout
    cost, quality : str
        Axis labels with their units.
    lower : bool
        A smaller quality number is better.
    """
    figure = new_figure(3.2)
    ax = figure.subplots()
    for kind in ("tried", "best", "reference", "chosen"):
        some = [layout for layout in layouts if layout.kind == kind]
        if some:
            ax.scatter(
                [s.cost for s in some],
                [s.quality for s in some],
                marker=MARKER[kind],
                s=SIZE[kind],
                color=COLOUR[kind],
                label=WORD[kind],
                zorder=4 if kind != "tried" else 2,
                linewidths=0,
            )
    front = sorted((x for x in layouts if x.kind == "best"), key=lambda x: x.cost)
    ax.plot([x.cost for x in front], [x.quality for x in front], color=BLUE, linewidth=1.0, zorder=3)
    named = [x for x in layouts if x.kind != "tried"]
    if len(named) <= 14:
        for i, layout in enumerate(named):
            ax.annotate(
                shorten(layout.name, 26),
                (layout.cost, layout.quality),
                xytext=(6, 5 if i % 2 else -11),
                textcoords="offset points",
                fontsize=7.5,
            )
    values = np.array([x.quality for x in layouts])
    if (values > 0).all() and values.max() > 20 * values.min():
        ax.set_yscale("log")
    ax.margins(x=0.1, y=0.12)
    ax.set_xlabel(cost)
    ax.set_ylabel(f"{quality} ({'lower' if lower else 'higher'} is better)")
    quiet_axis(ax, grid="both")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure
