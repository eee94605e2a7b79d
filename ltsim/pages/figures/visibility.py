"""Who sees whom, and why not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ltsim.pages.style import CYCLE, GREEN, ON_DEEP, bare, new_figure, shorten, styled

CLEAR = ("", "visible", "clear", "ok")


@styled
def visibility(stations: Sequence[str], targets: Sequence[str], reasons: Sequence[Sequence[str]]) -> Figure:
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
