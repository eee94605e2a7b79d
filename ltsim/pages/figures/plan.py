"""What a plan is worth: cost against quality, who sees whom, reflectors to move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ltsim.pages.figures.floor_plan import floor_plan
from ltsim.pages.style import (
    BLUE,
    CYCLE,
    GREEN,
    GREY,
    INK,
    ON_DEEP,
    PURPLE,
    RED,
    bare,
    new_figure,
    quiet_axis,
    shorten,
    styled,
)
from ltsim.pages.workshop import Workshop
from ltsim.planning.floor import Floor
from ltsim.planning.schema import ChangeEntry
from ltsim.units import MILLIMETRE

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


CLEAR = ("", "visible", "clear", "ok")


@styled
def visibility_figure(stations: Sequence[str], targets: Sequence[str], reasons: Sequence[Sequence[str]]) -> Figure:
    """A table of colours, stations by targets; hidden pairs are coloured by their reason and carry its initial.

    Parameters
    ----------
    stations, targets : sequence of str
    reasons : (S, T) of str
        Why a station does not see a target; '' where it does.
    """
    words = sorted({reason for line in reasons for reason in line if reason not in CLEAR})
    place = {word: i + 1 for i, word in enumerate(words)}
    table = np.array([[place.get(reason, 0) for reason in line] for line in reasons])
    palette = [c for c in CYCLE if c != GREEN]
    colours = ["#BFE3D3", *(palette[i % len(palette)] for i in range(len(words)))]
    figure = new_figure(1.15 + 0.26 * len(stations))
    ax = figure.subplots()
    ax.pcolormesh(
        table, cmap=ListedColormap(colours), vmin=-0.5, vmax=len(colours) - 0.5, edgecolors="white", linewidth=1.2
    )
    for s, line in enumerate(reasons):
        for t, reason in enumerate(line):
            if reason not in CLEAR:
                ax.text(t + 0.5, s + 0.5, reason[0].upper(), ha="center", va="center", color=ON_DEEP, fontsize=7)
    every = -(-len(targets) // 40)
    ax.set_xticks(
        np.arange(len(targets))[::every] + 0.5, [shorten(t, 12) for t in targets][::every], rotation=90, fontsize=7
    )
    ax.set_yticks(np.arange(len(stations)) + 0.5, [shorten(s, 20) for s in stations])
    ax.invert_yaxis()
    bare(ax)
    handles = [Patch(color=colours[0], label="visible")]
    handles += [Patch(color=colours[i + 1], label=f"{word[0].upper()}: {word}") for i, word in enumerate(words)]
    figure.legend(handles=handles, loc="outside upper left", ncols=min(len(handles), 4))
    return figure


ONE_MARK = 0.04
"""Share of the hall's size within which places have one mark, seen from above."""


@styled
def reflector_changes(workshop: Workshop, changes: Sequence[ChangeEntry], ground: Floor | None = None) -> Figure:
    """The floor plan with each change and its number: moves as arrows, crosses are left out."""
    figure = floor_plan(workshop, ground=ground)
    ax = figure.axes[0]
    place = dict(zip(workshop.targets, workshop.points[:, :2].tolist(), strict=True))
    numbers: dict[tuple[float, float], list[int]] = {}
    for number, change in enumerate(changes, 1):
        if change.position_mm is None:
            x, y = place[change.reflector]
            ax.scatter(x, y, marker="x", s=60, color=RED, linewidths=1.6, zorder=9)
            continue
        x, y = (v * MILLIMETRE for v in change.position_mm[:2])
        near = next((p for p in numbers if hypot(p[0] - x, p[1] - y) < ONE_MARK * workshop.size), (x, y))
        numbers.setdefault(near, []).append(number)
        if change.reflector:
            arrow = {"arrowstyle": "-|>", "color": PURPLE, "lw": 1.3, "shrinkA": 3, "shrinkB": 9}
            ax.annotate("", near, xytext=place[change.reflector], arrowprops=arrow, zorder=9)
    for (x, y), own in numbers.items():
        ring = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": PURPLE, "linewidth": 1.2}
        ax.text(x, y, ", ".join(map(str, own)), fontsize=7, ha="center", va="center", color=INK, bbox=ring, zorder=11)
    return figure
