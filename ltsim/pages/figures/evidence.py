"""Evidence for each explanation of a mismatch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from ltsim.pages.style import GREY, RED, SKY, category_rows, new_figure, number, styled


@dataclass(frozen=True)
class Candidate:
    """An explanation: its name, probability and what it removes from chi-square (None where unknown)."""

    name: str
    probability: float
    chi2_drop: float | None = None
    parameters: int | None = None
    kind: str = "equivalent"
    """'finding', or 'equivalent': cannot be excluded."""


@styled
def evidence(rows: Sequence[Candidate], *, most: int = 20) -> Figure:
    """Bars of probability; chi-square and parameters in words at their end. Findings are dark, equivalents pale."""
    rows = rows[:most]
    figure = new_figure(0.75 + 0.24 * max(len(rows), 2))
    ax = figure.subplots()
    places = category_rows(ax, [row.name for row in rows])
    for kind, colour, word in (("finding", RED, "finding"), ("equivalent", SKY, "cannot be excluded")):
        chosen = [i for i, row in enumerate(rows) if row.kind == kind]
        if chosen:
            ax.barh(places[chosen], [rows[i].probability for i in chosen], height=0.62, color=colour, label=word)
    for place, row in zip(places, rows, strict=True):
        text = f" {100 * row.probability:.3g} %"
        if row.chi2_drop is not None:
            text += f"   χ² falls by {number(row.chi2_drop)}"
            text += (
                f" for {row.parameters} parameter{'s' * (row.parameters != 1)}" if row.parameters is not None else ""
            )
        wide = row.probability > 0.55
        ax.text(
            row.probability,
            place,
            text + ("  " if wide else ""),
            va="center",
            ha="right" if wide else "left",
            fontsize=7.5,
            color="white" if wide and row.kind == "finding" else "#22272B",
        )
    ax.set_xlim(0, 1)
    ax.axvline(0.0, color=GREY, linewidth=0.7)
    ax.xaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    ax.set_xlabel("probability")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure
