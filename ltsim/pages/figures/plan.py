"""What a plan is worth: cost against quality, who sees whom, reflectors to move."""

from collections.abc import Sequence
from math import hypot
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ltsim.pages import style
from ltsim.pages.figures.floor_plan import Label, floor_plan
from ltsim.pages.words import QUALITY, typeset
from ltsim.pages.workshop import PlacedWorkshop
from ltsim.planning.floor import Floor
from ltsim.planning.schema import PlanChange, PlanResult
from ltsim.units import MILLIMETRE

COLOUR = {"tried": style.GREY, "best": style.BLUE, "chosen": style.RED, "reference": style.GREEN}
MARKER = {"tried": ".", "best": "o", "chosen": "*", "reference": "D"}
SIZE = {"tried": 34, "best": 30, "chosen": 150, "reference": 46}
WORD = {"tried": "tried", "best": "best at its cost", "chosen": "the plan", "reference": "reference"}


@style.styled
def trade_off(plan: PlanResult, name: str) -> Figure:
    """Time against one quality of a plan's goal; the line joins the layouts that are best at their cost."""
    label, factor = QUALITY.get(name, (name, 1.0))
    kinds: dict[str, list[tuple[float, float, str]]] = {"tried": [], "best": [], "reference": [], "chosen": []}
    for option in plan.tradeoff:
        way = f"{option.stations}s {option.faces}f {option.repeats}r"
        kinds["best" if option.efficient else "tried"].append((option.hours, option.quality.get(name) or np.nan, way))
    for kind, layout in (("reference", plan.reference), ("chosen", plan)):
        if layout is not None and layout.quality.get(name) is not None:
            kinds[kind].append((layout.hours, layout.quality[name] or np.nan, ""))
    figure, ax = style.panel(3.2)
    every = np.array([factor * quality for some in kinds.values() for _, quality, _ in some])
    for kind, some in kinds.items():
        if some:
            hours, quality = zip(*((h, factor * q) for h, q, _ in sorted(some)), strict=True)
            look: dict[str, Any] = {"marker": MARKER[kind], "s": SIZE[kind], "color": COLOUR[kind], "label": WORD[kind]}
            ax.scatter(hours, quality, zorder=4 if kind != "tried" else 2, linewidths=0, **look)
            if kind == "best":
                ax.plot(hours, quality, color=style.BLUE, linewidth=1.0, zorder=3)
    for hour, size, way in kinds["best"][:MOST_NAMED]:
        ax.annotate(way, (hour, factor * size), xytext=(6, 5), textcoords="offset points", fontsize=7.5)
    if (every > 0).all() and every.max() > 20 * every.min():
        ax.set_yscale("log")
    ax.margins(x=0.1, y=0.12)
    ax.set_xlabel("time on the floor [h]; s: stations, f: faces, r: rounds")
    ax.set_ylabel(f"{typeset(label)}\n(lower is better)")
    style.quiet_axis(ax, grid="both")
    style.legend_of(figure, [ax], ncols=2)
    return figure


MOST_NAMED = 14
"""Layouts that can be named in one picture."""
ONE_MARK = 0.04
"""Share of the hall's size within which places have one mark, seen from above."""


@style.styled
def reflector_changes(workshop: PlacedWorkshop, changes: Sequence[PlanChange], ground: Floor | None = None) -> Figure:
    """The floor plan with each change and its number: moves as arrows, crosses are left out."""
    known = dict(zip(workshop.targets, workshop.points[:, :2].tolist(), strict=True))

    def marks(ax: Axes) -> list[Label]:
        labels = []
        kinds = (True, "D", style.PURPLE, "new place, by number"), (False, "x", style.RED, "can go, by number")
        for new, marker, colour, word in kinds:
            numbers: dict[tuple[float, float], list[int]] = {}
            for number, change in enumerate(changes, 1):
                if (change.position_mm is not None) != new:
                    continue
                there = change.position_mm
                x, y = (v * MILLIMETRE for v in there[:2]) if there else known[change.reflector]
                near = next((p for p in numbers if hypot(p[0] - x, p[1] - y) < ONE_MARK * workshop.size), (x, y))
                numbers.setdefault(near, []).append(number)
                if new and change.reflector:
                    arrow = {"arrowstyle": "-|>", "color": style.PURPLE, "lw": 1.3, "shrinkA": 3, "shrinkB": 4}
                    ax.annotate("", near, xytext=known[change.reflector], arrowprops=arrow, zorder=8)
            if numbers:
                at = np.array([*numbers]).T
                ax.scatter(at[0], at[1], marker=marker, s=40, color=colour, zorder=9, label=word)
            labels += [Label(", ".join(map(str, n)), np.array(at), 8.0, bold=True) for at, n in numbers.items()]
        return labels

    return floor_plan(workshop, ground=ground, marks=marks)
