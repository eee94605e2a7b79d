"""How large an effect must be before it is found and named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from ltsim.arrays import Floats
from ltsim.report.style import CYCLE, GREY, new_figure, quiet_axis, styled


@dataclass(frozen=True)
class PowerCurve:
    """Successes out of trials at each strength; strengths, successes and trials are (k,)."""

    name: str
    strength: Floats
    successes: Floats
    trials: Floats

    def interval(self) -> tuple[Floats, Floats]:
        """95 % interval of each share (Wilson 1927)."""
        pairs = [
            stats.binomtest(int(s), int(n)).proportion_ci(0.95, method="wilson")
            for s, n in zip(self.successes, self.trials, strict=True)
        ]
        return np.array([p.low for p in pairs]), np.array([p.high for p in pairs])


@styled
def power(
    curves: Sequence[PowerCurve],
    *,
    goals: Sequence[tuple[float, float]] = (),
    strength: str = "noncentrality of the effect",
) -> Figure:
    """Share of trials against strength with 95 % intervals; `goals` are (strength, share) that had to be reached."""
    figure = new_figure(3.1)
    ax = figure.subplots()
    markers = "osD^vP*X"
    for i, curve in enumerate(curves):
        colour = CYCLE[i % len(CYCLE)]
        low, high = curve.interval()
        share = curve.successes / curve.trials
        ax.fill_between(curve.strength, low, high, color=colour, alpha=0.16, linewidth=0)
        ax.plot(curve.strength, share, color=colour, marker=markers[i % len(markers)], markersize=4.5, label=curve.name)
    if goals:
        ax.scatter(
            [g[0] for g in goals],
            [g[1] for g in goals],
            marker="_",
            s=220,
            color=GREY,
            linewidths=2.2,
            label="asked for",
            zorder=1,
        )
    positive = [s for curve in curves for s in curve.strength if s > 0]
    if positive and max(positive) > 8 * min(positive) and all((c.strength > 0).all() for c in curves):
        ax.set_xscale("log")
        ticks = sorted(set(positive))
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
    ax.set_ylim(-0.02, 1.03)
    ax.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    ax.set_xlabel(strength)
    ax.set_ylabel("share of the trials")
    quiet_axis(ax, grid="both")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper")
    return figure
