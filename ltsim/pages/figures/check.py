"""A check at a glance: two-face differences against their limits, and what each pointing misses against the clock."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ltsim.fieldcheck.check import Check
from ltsim.pages.style import BLUE, CYCLE, GREEN, INK, ORANGE, RED, new_figure, quiet_axis, shorten, styled

OBSERVABLES = (("range", BLUE, "o"), ("across the beam", ORANGE, "s"), ("elevation", GREEN, "^"))
MOST_NAMES = 40
MOST_STATIONS = 8


@styled
def check_figure(check: Check) -> Figure:
    """Two panels: half two-face differences over their limits, target by target; misfit of pointings over time."""
    figure = new_figure(5.2)
    above, below = figure.subplots(2, 1)
    _faces(above, check)
    _course(below, check)
    figure.suptitle("go" if check.passed else "no-go", x=0.01, ha="left", color=GREEN if check.passed else RED)
    return figure


def _faces(ax: Axes, check: Check) -> None:
    names: list[str] = []
    at = 0
    for setup in check.setups:
        if setup.faces is None:
            continue
        share = setup.faces.pairs.half / setup.faces.limit
        places = at + np.arange(len(share))
        for column, (what, colour, marker) in enumerate(OBSERVABLES):
            label = what if at == 0 else None
            ax.plot(places, share[:, column], marker, ms=3.2, color=colour, label=label, alpha=0.85)
        rows = setup.rows[setup.faces.pairs.rows[:, 0]] - 1
        names += [check.recording.targets[check.recording.target[row]] for row in rows]
        at += len(share)
        ax.axvline(at - 0.5, color=INK, lw=0.4)
    for limit in (-1.0, 1.0):
        ax.axhline(limit, color=RED, lw=1.0)
    quiet_axis(ax)
    ax.set_title("Half two-face differences over their limits")
    ax.set_ylabel("share of the limit")
    if not names:
        ax.text(0.5, 0.5, "no target was measured on both faces", transform=ax.transAxes, ha="center")
        ax.set_xticks([])
        return
    ax.set_xlim(-0.8, at - 0.2)
    few = len(names) <= MOST_NAMES
    ax.set_xticks(range(at) if few else [], [shorten(n) for n in names] if few else [], rotation=90, fontsize=6)
    ax.legend(loc="upper right", ncols=3)


def _course(ax: Axes, check: Check) -> None:
    scale, unit = (60.0, "time [min]") if check.recording.has_clock else (1.0, "pointing")
    for i, setup in enumerate(check.setups):
        if setup.visit is None:
            continue
        size = np.sqrt(np.mean(setup.visit.whitened**2, axis=1))
        label = setup.station if i < MOST_STATIONS else None
        ax.plot(setup.visit.recording.time / scale, size, ".", ms=4, color=CYCLE[i % len(CYCLE)], label=label)
    marked = False
    for item in check.items:
        if item.between_s is not None:
            ax.axvspan(item.between_s[0] / scale, item.between_s[1] / scale, color=RED, alpha=0.35, lw=0)
            ax.axvline(item.between_s[0] / scale, color=RED, lw=1.0, label=None if marked else "moved")
            marked = True
    quiet_axis(ax)
    ax.set_title("What each pointing misses")
    ax.set_xlabel(unit)
    ax.set_ylabel("rms [sigma]")
    ax.set_ylim(bottom=0)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="upper right", ncols=4)
